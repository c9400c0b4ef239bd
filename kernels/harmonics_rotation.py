"""Rotation of real spherical harmonics, degrees 1 to 3: f'(d) = f(R^T d).

A band of degree l has 2 l + 1 functions, so its values in 2 l + 1 directions say everything: the turned function is
evaluated there, and a constant matrix leads back to coefficients.
"""

import warp as wp

from .harmonics import C1, C2, C3Z, C20, C22, C30, C31, C32, C33
from .quaternion import quat_conjugate, quat_normalise, quat_rotate

wp.set_module_options({"enable_backward": False})


@wp.func
def band_value(degree: int, k: int, d: wp.vec3, sh_rest: wp.array[wp.vec3]) -> wp.vec3:
    """What one band adds to the colour in direction ``d``; ``k``: row of its first coefficient."""
    x = d[0]
    y = d[1]
    z = d[2]
    if degree == 1:
        return C1 * (z * sh_rest[k + 1] - y * sh_rest[k] - x * sh_rest[k + 2])
    xx = x * x
    yy = y * y
    zz = z * z
    if degree == 2:
        return (
            (C2 * x * y) * sh_rest[k]
            - (C2 * y * z) * sh_rest[k + 1]
            + (C20 * (3.0 * zz - 1.0)) * sh_rest[k + 2]
            - (C2 * x * z) * sh_rest[k + 3]
            + (C22 * (xx - yy)) * sh_rest[k + 4]
        )
    return (
        (C33 * y * (yy - 3.0 * xx)) * sh_rest[k]
        + (C32 * x * y * z) * sh_rest[k + 1]
        + (C31 * y * (1.0 - 5.0 * zz)) * sh_rest[k + 2]
        + (C30 * z * (5.0 * zz - 3.0)) * sh_rest[k + 3]
        + (C31 * x * (1.0 - 5.0 * zz)) * sh_rest[k + 4]
        + (C3Z * z * (xx - yy)) * sh_rest[k + 5]
        + (C33 * x * (3.0 * yy - xx)) * sh_rest[k + 6]
    )


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
    """The identity, to the bit, changes nothing."""
    i = first + wp.tid()
    q = quats_in[i]
    k = i * rest
    turns = q[1] != 0.0 or q[2] != 0.0 or q[3] != 0.0
    if not turns or not wp.isfinite(wp.dot(q, q)):
        for row in range(rest):
            sh_rest_out[k + row] = sh_rest_in[k + row]
    else:
        back = quat_conjugate(quat_normalise(q))
        direction = int(0)
        matrix = int(0)
        row = int(0)
        for degree in range(1, 4):
            size = 2 * degree + 1
            if row < rest:
                for m in range(size):
                    sh_rest_out[k + row + m] = wp.vec3(0.0)
                for v in range(size):
                    value = band_value(degree, k + row, quat_rotate(back, directions_in[direction + v]), sh_rest_in)
                    for m in range(size):
                        sh_rest_out[k + row + m] = sh_rest_out[k + row + m] + inverses_in[matrix + m * size + v] * value
            direction += size
            matrix += size * size
            row += size
