"""Brightness that follows the turn of a surface: a function of its rotation, of each Gaussian's own.

To first order the light that a diffuse surface reflects is linear in its normal (an environment's irradiance up to
degree 1), so while a surface turns by R it changes by ``x = <G, R - I>`` in proportion, where G holds light and normal.
A lamp's light, which is cut off at grazing angles, bends away from that: hence a quadratic term of x.
"""

import warp as wp

from .quaternion import quat_conjugate, quat_matrix, quat_multiply, quat_normalise

wp.set_module_options({"enable_backward": False})

MOST = wp.constant(4.0)
"""No Gaussian becomes brighter than so many times its colour at rest."""
BEND = wp.constant(5.0)
"""Of the quadratic term's coefficient, so that it learns about as fast as G."""
GREY = wp.constant(1.7724538509055159)
"""0.5 / C0: the coefficient of degree 0 is the colour less one half, over C0."""


@wp.func
def turned(quat: wp.vec4, quat_t: wp.vec4) -> wp.mat33:
    """R - I of the rotation that leads from ``quat`` to ``quat_t``."""
    rotation = quat_matrix(quat_multiply(quat_normalise(quat_t), quat_conjugate(quat_normalise(quat))))
    return rotation - wp.identity(n=3, dtype=float)


@wp.func
def response(i: int, shading: wp.array2d[float], turn: wp.mat33) -> float:
    """x = <G, R - I>."""
    total = float(0.0)
    for r in range(3):
        for c in range(3):
            total += shading[i, 3 * r + c] * turn[r, c]
    return total


@wp.func
def gain(x: float, bend: float) -> float:
    """1 + x + 5 b x^2, not limited, finite or not."""
    return 1.0 + x + BEND * bend * x * x


@wp.func
def limited(free: float) -> float:
    """The gain within its limits; 1 where it is not finite."""
    if not wp.isfinite(free):
        return 1.0
    return wp.clamp(free, 0.0, MOST)


@wp.kernel
def shade(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]
    shading_in: wp.array2d[float],  # [N, 10] G by rows, b
    quats_in: wp.array[wp.vec4],  # [N] at rest, any norm
    quats_t_in: wp.array[wp.vec4],  # [N] posed, any norm
    # Out:
    sh_dc_out: wp.array[wp.vec3],  # [N]
):
    i = first + wp.tid()
    x = response(i, shading_in, turned(quats_in[i], quats_t_in[i]))
    factor = limited(gain(x, shading_in[i, 9]))
    grey = wp.vec3(GREY, GREY, GREY)
    sh_dc_out[i] = factor * (sh_dc_in[i] + grey) - grey


@wp.kernel
def shade_adjoint(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]
    shading_in: wp.array2d[float],  # [N, 10]
    quats_in: wp.array[wp.vec4],  # [N]
    quats_t_in: wp.array[wp.vec4],  # [N]
    v_sh_dc_t_in: wp.array[wp.vec3],  # [N]
    # Out:
    v_sh_dc_out: wp.array[wp.vec3],  # [N]
    v_shading_out: wp.array2d[float],  # [N, 10]
):
    """A gain that is limited, or replaced as it is not finite, passes nothing to G and b."""
    i = first + wp.tid()
    turn = turned(quats_in[i], quats_t_in[i])
    x = response(i, shading_in, turn)
    bend = shading_in[i, 9]
    free = gain(x, bend)
    factor = limited(free)
    v_sh_dc_out[i] = factor * v_sh_dc_t_in[i]
    v_factor = float(0.0)
    if wp.isfinite(free) and free == factor:
        v_factor = wp.dot(v_sh_dc_t_in[i], sh_dc_in[i] + wp.vec3(GREY, GREY, GREY))
    v_x = v_factor * (1.0 + 2.0 * BEND * bend * x)
    v_bend = v_factor * BEND * x * x
    if not wp.isfinite(v_x * (turn[0, 0] + turn[1, 1] + turn[2, 2]) + v_bend):
        v_x = 0.0
        v_bend = 0.0
        turn = wp.mat33(0.0)
    for r in range(3):
        for c in range(3):
            v_shading_out[i, 3 * r + c] = v_x * turn[r, c]
    v_shading_out[i, 9] = v_bend
