"""Shading: each Gaussian's brightness as a function of its own rotation.

To first order the light that a diffuse surface reflects is linear in its normal (an environment's irradiance up to
degree 1). If a surface turns by R, its brightness therefore changes by the relative amount ``x = <G, R - I>``, where G
combines light and normal. A term quadratic in x approximates the cut-off of a lamp's light at grazing angles.

A tint changes a Gaussian's colour without any rotation, as a shadow does that falls on it: it is the change of the
colour's logarithm.
"""

import warp as wp

from .quaternion import rotation_between

wp.set_module_options({"enable_backward": False})

GAIN_MAX = wp.constant(4.0)
"""Upper limit of a Gaussian's brightness, relative to its brightness at rest."""
BEND = wp.constant(5.0)
"""Scale of the quadratic term's coefficient, chosen so that the coefficient learns about as fast as G."""
TINT_MIN, TINT_MAX = wp.constant(-3.0), wp.constant(1.0)
"""Limits of a tint: factors 0.05 and 2.7 on a Gaussian's colour."""
GREY = wp.constant(1.7724538509055159)
"""Constant 0.5 / C0: the coefficient of degree 0 is (colour - 0.5) / C0."""


@wp.func
def turned(quat: wp.vec4, quat_t: wp.vec4) -> wp.mat33:
    """Return R - I for the rotation R from ``quat`` to ``quat_t``."""
    return rotation_between(quat, quat_t) - wp.identity(n=3, dtype=float)


@wp.func
def response(i: int, shading: wp.array2d[float], turn: wp.mat33) -> float:
    """Return x = <G, R - I>."""
    total = float(0.0)
    for r in range(3):
        for c in range(3):
            total += shading[i, 3 * r + c] * turn[r, c]
    return total


@wp.func
def gain(x: float, bend: float) -> float:
    """Return the gain 1 + x + 5 b x^2 before limits and checks."""
    return 1.0 + x + BEND * bend * x * x


@wp.func
def limited(free: float) -> float:
    """Clamp the gain to its limits; return 1 where it is non-finite."""
    if not wp.isfinite(free):
        return 1.0
    return wp.clamp(free, 0.0, GAIN_MAX)


@wp.func
def shaded(i: int, sh_dc: wp.vec3, shading: wp.array2d[float], quat: wp.vec4, quat_t: wp.vec4) -> wp.vec3:
    """Return the colour of degree 0 of Gaussian i, scaled by its gain."""
    x = response(i, shading, turned(quat, quat_t))
    factor = limited(gain(x, shading[i, 9]))
    grey = wp.vec3(GREY, GREY, GREY)
    return factor * (sh_dc + grey) - grey


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
    """Scale the colour of degree 0 by the gain. Grid: N."""
    i = first + wp.tid()
    sh_dc_out[i] = shaded(i, sh_dc_in[i], shading_in, quats_in[i], quats_t_in[i])


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
    """Compute the gradients of colour, G and b; a limited or replaced gain passes no gradient to G and b. Grid: N."""
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


@wp.func
def tint_factor(tint: float) -> float:
    """Return the factor on a colour, within its limits; 1 where the tint is non-finite."""
    if not wp.isfinite(tint):
        return 1.0
    return wp.exp(wp.clamp(tint, TINT_MIN, TINT_MAX))


@wp.func
def tinted(sh_dc: wp.vec3, tint: wp.vec3) -> wp.vec3:
    """Return the colour of degree 0 with each channel scaled by its factor."""
    color = sh_dc
    for c in range(3):
        color[c] = tint_factor(tint[c]) * (color[c] + GREY) - GREY
    return color


@wp.kernel
def tint(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]
    tints_in: wp.array[wp.vec3],  # [N]
    # Out:
    sh_dc_out: wp.array[wp.vec3],  # [N]
):
    """Scale the colour of degree 0, each channel by its factor. Grid: N."""
    i = first + wp.tid()
    sh_dc_out[i] = tinted(sh_dc_in[i], tints_in[i])


@wp.kernel
def tint_adjoint(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]
    tints_in: wp.array[wp.vec3],  # [N]
    v_sh_dc_t_in: wp.array[wp.vec3],  # [N]
    # Out:
    v_sh_dc_out: wp.array[wp.vec3],  # [N]
    v_tints_out: wp.array[wp.vec3],  # [N]
):
    """Compute the gradients of colour and tint; a limited or non-finite tint gets none. Grid: N."""
    i = first + wp.tid()
    v_sh_dc = v_sh_dc_t_in[i]
    v_tints = wp.vec3(0.0)
    for c in range(3):
        t = tints_in[i][c]
        v_sh_dc[c] = tint_factor(t) * v_sh_dc[c]
        v = v_sh_dc[c] * (sh_dc_in[i][c] + GREY)
        if t > TINT_MIN and t < TINT_MAX and wp.isfinite(v):
            v_tints[c] = v
    v_sh_dc_out[i] = v_sh_dc
    v_tints_out[i] = v_tints
