"""Correctives, tints, shading and activations of moved Gaussians on a CPU: 16 at a time, one in each SIMD lane."""

import warp as wp

from ..native import native_function
from ..types import LANES

wp.set_module_options({"enable_backward": False})

_LANES = wp.constant(LANES)


# fmt: off
@native_function("finishing.h")
def finish_block(
    begin: int, means: wp.array[wp.vec3], log_scales: wp.array[wp.vec3], opacity_logits: wp.array[float],
    sh_dc: wp.array[wp.vec3], correctives: wp.array2d[float], shading: wp.array2d[float],
    extras_in: wp.array[wp.vec3], extras: int, quats: wp.array[wp.vec4], quats_t: wp.array[wp.vec4],
    quats_own: wp.array[wp.vec4], has_own: int, means_t: wp.array[wp.vec3], scales_t: wp.array[wp.vec3],
    opacities_t: wp.array[float], sh_dc_t: wp.array[wp.vec3],
): ...


@native_function("finishing.h")
def finish_block_adjoint(
    begin: int, scales_t: wp.array[wp.vec3], opacities_t: wp.array[float], sh_dc: wp.array[wp.vec3],
    correctives: wp.array2d[float], shading: wp.array2d[float], tints: wp.array[wp.vec3], extras: int,
    quats: wp.array[wp.vec4], quats_t: wp.array[wp.vec4], quats_own: wp.array[wp.vec4], has_own: int,
    v_means_t: wp.array[wp.vec3], v_scales_t: wp.array[wp.vec3], v_opacities_t: wp.array[float],
    v_sh_dc_t: wp.array[wp.vec3], v_log_scales: wp.array[wp.vec3], v_opacity_logits: wp.array[float],
    v_sh_dc: wp.array[wp.vec3], v_correctives: wp.array2d[float], v_shading: wp.array2d[float],
    v_tints: wp.array[wp.vec3],
): ...
# fmt: on


@wp.kernel
def finish(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N] skinned, touched only with correctives
    log_scales_in: wp.array[wp.vec3],  # [N]
    opacity_logits_in: wp.array[float],  # [N]
    sh_dc_in: wp.array[wp.vec3],  # [N]
    correctives_in: wp.array2d[float],  # [N, 27] or [N, 0]
    shading_in: wp.array2d[float],  # [N, 10] or [N, 0]
    extras_in: wp.array[wp.vec3],  # [N] touched only if there are any
    extras: int,  # what the extras change, as of posing; 0: there are none
    quats_in: wp.array[wp.vec4],  # [N] at rest, any norm; this and the next two touched only with either of the two
    quats_t_in: wp.array[wp.vec4],  # [N] posed, any norm
    quats_own_in: wp.array[wp.vec4],  # [N] that correctives and shading follow, touched only with has_own
    has_own: int,  # 0: they follow the posed ones
    # Out:
    means_out: wp.array[wp.vec3],  # [N] touched only with correctives
    scales_out: wp.array[wp.vec3],  # [N]
    opacities_out: wp.array[float],  # [N]
    sh_dc_out: wp.array[wp.vec3],  # [N] touched only with tints or shading
):
    """Displace, tint, shade and activate 16 Gaussians. Grid: ceil(N / 16)."""
    begin = (first + wp.tid()) * _LANES
    finish_block(
        begin, means_in, log_scales_in, opacity_logits_in, sh_dc_in, correctives_in, shading_in, extras_in, extras,
        quats_in, quats_t_in, quats_own_in, has_own, means_out, scales_out, opacities_out, sh_dc_out,
    )  # fmt: skip


@wp.kernel
def finish_adjoint(
    first: int,
    # In:
    scales_t_in: wp.array[wp.vec3],  # [N] results of finish
    opacities_t_in: wp.array[float],  # [N]
    sh_dc_in: wp.array[wp.vec3],  # [N] at rest, touched only with tints or shading
    correctives_in: wp.array2d[float],  # [N, 27] or [N, 0]
    shading_in: wp.array2d[float],  # [N, 10] or [N, 0]
    tints_in: wp.array[wp.vec3],  # [N] touched only with tints
    extras: int,
    quats_in: wp.array[wp.vec4],  # [N] this and the next two touched only with correctives or shading
    quats_t_in: wp.array[wp.vec4],  # [N]
    quats_own_in: wp.array[wp.vec4],  # [N] touched only with has_own
    has_own: int,
    v_means_t_in: wp.array[wp.vec3],  # [N] touched only with correctives
    v_scales_t_in: wp.array[wp.vec3],  # [N]
    v_opacities_t_in: wp.array[float],  # [N]
    v_sh_dc_t_in: wp.array[wp.vec3],  # [N] touched only with tints or shading
    # Out:
    v_log_scales_out: wp.array[wp.vec3],  # [N]
    v_opacity_logits_out: wp.array[float],  # [N]
    v_sh_dc_out: wp.array[wp.vec3],  # [N] touched only with tints or shading
    v_correctives_out: wp.array2d[float],  # [N, 27] touched only with correctives
    v_shading_out: wp.array2d[float],  # [N, 10] touched only with shading
    v_tints_out: wp.array[wp.vec3],  # [N] touched only with tints
):
    """Compute the gradients of 16 Gaussians, those of their means left out: they stay as they are. Grid:
    ceil(N / 16)."""
    begin = (first + wp.tid()) * _LANES
    finish_block_adjoint(
        begin, scales_t_in, opacities_t_in, sh_dc_in, correctives_in, shading_in, tints_in, extras,
        quats_in, quats_t_in, quats_own_in, has_own, v_means_t_in, v_scales_t_in, v_opacities_t_in, v_sh_dc_t_in,
        v_log_scales_out, v_opacity_logits_out, v_sh_dc_out, v_correctives_out, v_shading_out, v_tints_out,
    )  # fmt: skip
