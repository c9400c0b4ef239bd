"""Shading and tints on a CPU: 16 Gaussians at a time, one in each SIMD lane."""

import warp as wp

from ..native import native_function
from ..types import LANES

wp.set_module_options({"enable_backward": False})

_LANES = wp.constant(LANES)


# fmt: off
@native_function("shading.h")
def shade_block(
    begin: int, sh_dc: wp.array[wp.vec3], shading: wp.array2d[float], quats: wp.array[wp.vec4],
    quats_t: wp.array[wp.vec4], shaded: wp.array[wp.vec3],
): ...


@native_function("shading.h")
def shade_block_adjoint(
    begin: int, sh_dc: wp.array[wp.vec3], shading: wp.array2d[float], quats: wp.array[wp.vec4],
    quats_t: wp.array[wp.vec4], v_shaded: wp.array[wp.vec3], v_sh_dc: wp.array[wp.vec3], v_shading: wp.array2d[float],
): ...


@native_function("shading.h")
def tint_block(
    begin: int, sh_dc: wp.array[wp.vec3], tints: wp.array[wp.vec3], tinted: wp.array[wp.vec3],
): ...


@native_function("shading.h")
def tint_block_adjoint(
    begin: int, sh_dc: wp.array[wp.vec3], tints: wp.array[wp.vec3], v_tinted: wp.array[wp.vec3],
    v_sh_dc: wp.array[wp.vec3], v_tints: wp.array[wp.vec3],
): ...
# fmt: on


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
    """Scale 16 colours of degree 0 by their gains. Grid: ceil(N / 16)."""
    shade_block((first + wp.tid()) * _LANES, sh_dc_in, shading_in, quats_in, quats_t_in, sh_dc_out)


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
    """Compute the gradients of 16 colours, matrices G and coefficients b. Grid: ceil(N / 16)."""
    begin = (first + wp.tid()) * _LANES
    shade_block_adjoint(
        begin, sh_dc_in, shading_in, quats_in, quats_t_in, v_sh_dc_t_in, v_sh_dc_out, v_shading_out
    )  # fmt: skip


@wp.kernel
def tint(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]
    tints_in: wp.array[wp.vec3],  # [N]
    # Out:
    sh_dc_out: wp.array[wp.vec3],  # [N]
):
    """Scale 16 colours of degree 0, each channel by its factor. Grid: ceil(N / 16)."""
    tint_block((first + wp.tid()) * _LANES, sh_dc_in, tints_in, sh_dc_out)


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
    """Compute the gradients of 16 colours and tints. Grid: ceil(N / 16)."""
    tint_block_adjoint((first + wp.tid()) * _LANES, sh_dc_in, tints_in, v_sh_dc_t_in, v_sh_dc_out, v_tints_out)
