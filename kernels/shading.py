"""Brightness that follows the turn of a surface: a linear function of its rotation, of each Gaussian's own.

To first order the light that a diffuse surface reflects is linear in its normal (an environment's irradiance up to
degree 1), so while a surface turns by R it changes by ``<G, R - I>`` in proportion, where G holds light and normal.
"""

import warp as wp

from .quaternion import quat_conjugate, quat_matrix, quat_multiply, quat_normalise

wp.set_module_options({"enable_backward": False})

MOST = wp.constant(4.0)
"""No Gaussian becomes brighter than so many times its colour at rest."""
GREY = wp.constant(1.7724538509055159)
"""0.5 / C0: the coefficient of degree 0 is the colour less one half, over C0."""


@wp.func
def turned(quat: wp.vec4, quat_t: wp.vec4) -> wp.mat33:
    """R - I of the rotation that leads from ``quat`` to ``quat_t``."""
    rotation = quat_matrix(quat_multiply(quat_normalise(quat_t), quat_conjugate(quat_normalise(quat))))
    return rotation - wp.identity(n=3, dtype=float)


@wp.func
def gain(i: int, shading: wp.array2d[float], turn: wp.mat33) -> float:
    """1 + <G, R - I>, not limited; 1 where it is not finite."""
    total = float(1.0)
    for r in range(3):
        for c in range(3):
            total += shading[i, 3 * r + c] * turn[r, c]
    if not wp.isfinite(total):
        total = 1.0
    return total


@wp.kernel
def shade(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]
    shading_in: wp.array2d[float],  # [N, 9] G by rows
    quats_in: wp.array[wp.vec4],  # [N] at rest, any norm
    quats_t_in: wp.array[wp.vec4],  # [N] posed, any norm
    # Out:
    sh_dc_out: wp.array[wp.vec3],  # [N]
):
    i = first + wp.tid()
    factor = wp.clamp(gain(i, shading_in, turned(quats_in[i], quats_t_in[i])), 0.0, MOST)
    grey = wp.vec3(GREY, GREY, GREY)
    sh_dc_out[i] = factor * (sh_dc_in[i] + grey) - grey


@wp.kernel
def shade_adjoint(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]
    shading_in: wp.array2d[float],  # [N, 9]
    quats_in: wp.array[wp.vec4],  # [N]
    quats_t_in: wp.array[wp.vec4],  # [N]
    v_sh_dc_t_in: wp.array[wp.vec3],  # [N]
    # Out:
    v_sh_dc_out: wp.array[wp.vec3],  # [N]
    v_shading_out: wp.array2d[float],  # [N, 9]
):
    """A limited gain passes nothing to G."""
    i = first + wp.tid()
    turn = turned(quats_in[i], quats_t_in[i])
    free = gain(i, shading_in, turn)
    factor = wp.clamp(free, 0.0, MOST)
    v_sh_dc_out[i] = factor * v_sh_dc_t_in[i]
    v_factor = float(0.0)
    if free == factor:
        v_factor = wp.dot(v_sh_dc_t_in[i], sh_dc_in[i] + wp.vec3(GREY, GREY, GREY))
    for r in range(3):
        for c in range(3):
            v = v_factor * turn[r, c]
            if not wp.isfinite(v):
                v = 0.0
            v_shading_out[i, 3 * r + c] = v
