"""Rotation of real spherical harmonics, degrees 1 to 3: f'(d) = f(R^T d).

A band of degree l has 2 l + 1 functions, so its values in 2 l + 1 directions determine it. The rotated function is
evaluated in those directions, and a constant matrix turns the values back into coefficients.
"""

import warp as wp

from .harmonics import C1, C2, C3Z, C20, C22, C30, C31, C32, C33
from .quaternion import quat_conjugate, quat_normalise, quat_rotate

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


mat33 = wp.types.matrix(shape=(3, 3), dtype=float)
mat53 = wp.types.matrix(shape=(5, 3), dtype=float)
mat73 = wp.types.matrix(shape=(7, 3), dtype=float)


@wp.func
def turn_first(k: int, back: wp.vec4, directions: wp.array[wp.vec3], inverses: wp.array[float],
               sh_in: wp.array[wp.vec3], sh_out: wp.array[wp.vec3]):  # fmt: skip
    """Rotate the band of degree 1, whose first coefficient is in row ``k``.

    Warp unrolls loops over constants, so the values stay in registers.
    """
    values = mat33()
    for v in range(3):
        d = quat_rotate(back, directions[v])
        values[v] = C1 * (d[2] * sh_in[k + 1] - d[1] * sh_in[k] - d[0] * sh_in[k + 2])
    for m in range(3):
        total = wp.vec3(0.0)
        for v in range(3):
            total += inverses[m * 3 + v] * values[v]
        sh_out[k + m] = total


@wp.func
def turn_second(k: int, back: wp.vec4, directions: wp.array[wp.vec3], inverses: wp.array[float],
                sh_in: wp.array[wp.vec3], sh_out: wp.array[wp.vec3]):  # fmt: skip
    """Rotate the band of degree 2, whose first coefficient is in row ``k``."""
    values = mat53()
    for v in range(5):
        d = quat_rotate(back, directions[3 + v])
        x = d[0]
        y = d[1]
        z = d[2]
        values[v] = (
            (C2 * x * y) * sh_in[k]
            - (C2 * y * z) * sh_in[k + 1]
            + (C20 * (3.0 * z * z - 1.0)) * sh_in[k + 2]
            - (C2 * x * z) * sh_in[k + 3]
            + (C22 * (x * x - y * y)) * sh_in[k + 4]
        )
    for m in range(5):
        total = wp.vec3(0.0)
        for v in range(5):
            total += inverses[9 + m * 5 + v] * values[v]
        sh_out[k + m] = total


@wp.func
def turn_third(k: int, back: wp.vec4, directions: wp.array[wp.vec3], inverses: wp.array[float],
               sh_in: wp.array[wp.vec3], sh_out: wp.array[wp.vec3]):  # fmt: skip
    """Rotate the band of degree 3, whose first coefficient is in row ``k``."""
    values = mat73()
    for v in range(7):
        d = quat_rotate(back, directions[8 + v])
        x = d[0]
        y = d[1]
        z = d[2]
        xx = x * x
        yy = y * y
        zz = z * z
        values[v] = (
            (C33 * y * (yy - 3.0 * xx)) * sh_in[k]
            + (C32 * x * y * z) * sh_in[k + 1]
            + (C31 * y * (1.0 - 5.0 * zz)) * sh_in[k + 2]
            + (C30 * z * (5.0 * zz - 3.0)) * sh_in[k + 3]
            + (C31 * x * (1.0 - 5.0 * zz)) * sh_in[k + 4]
            + (C3Z * z * (xx - yy)) * sh_in[k + 5]
            + (C33 * x * (3.0 * yy - xx)) * sh_in[k + 6]
        )
    for m in range(7):
        total = wp.vec3(0.0)
        for v in range(7):
            total += inverses[34 + m * 7 + v] * values[v]
        sh_out[k + m] = total


@wp.kernel
def rotate_harmonics(
    first: int,
    # In:
    sh_rest_in: wp.array[wp.vec3],  # [N * R]
    rest: int,  # R: 3, 8 or 15
    quats_in: wp.array[wp.vec4],  # [N] wxyz, any norm
    directions_in: wp.array[wp.vec3],  # [15] unit: 3, 5 and 7 of them
    inverses_in: wp.array[float],  # [9 + 25 + 49] values in those directions to coefficients
    # Out:
    sh_rest_out: wp.array[wp.vec3],  # [N * R]
):
    """Rotate all bands of a Gaussian; an exact identity leaves them bit-identical. Grid: N."""
    i = first + wp.tid()
    q = quats_in[i]
    k = i * rest
    turns = q[1] != 0.0 or q[2] != 0.0 or q[3] != 0.0
    if not turns or not wp.isfinite(wp.dot(q, q)):
        for row in range(rest):
            sh_rest_out[k + row] = sh_rest_in[k + row]
    else:
        back = quat_conjugate(quat_normalise(q))
        if rest > 0:
            turn_first(k, back, directions_in, inverses_in, sh_rest_in, sh_rest_out)
        if rest > 3:
            turn_second(k + 3, back, directions_in, inverses_in, sh_rest_in, sh_rest_out)
        if rest > 8:
            turn_third(k + 8, back, directions_in, inverses_in, sh_rest_in, sh_rest_out)
