"""Posing without gradients on a CPU: 16 Gaussians at a time, one in each SIMD lane."""

import warp as wp

from ..native import native_function
from ..types import LANES

wp.set_module_options({"enable_backward": False})

_LANES = wp.constant(LANES)


# fmt: off
@native_function("posing.h")
def pose_block(
    begin: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
    opacity_logits: wp.array[float], sh_dc: wp.array[wp.vec3], correctives: wp.array2d[float],
    shading: wp.array2d[float], motion: wp.array2d[float], reach: wp.array2d[float], aligned: int, extras: int,
    indices: wp.array2d[wp.int32], weights: wp.array2d[float], quats_own: wp.array[wp.vec4], has_own: int,
    means_t: wp.array[wp.vec3], quats_t: wp.array[wp.vec4], scales_t: wp.array[wp.vec3],
    opacities_t: wp.array[float], sh_dc_t: wp.array[wp.vec3],
): ...
# fmt: on


@wp.kernel
def pose_gaussians(
    first: int,
    # In: Gaussians at rest
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N] wxyz, any norm
    log_scales_in: wp.array[wp.vec3],  # [N]
    opacity_logits_in: wp.array[float],  # [N]
    sh_dc_in: wp.array[wp.vec3],  # [N]
    correctives_in: wp.array2d[float],  # [N, 27] or [N, 0]
    shading_in: wp.array2d[float],  # [N, 10] or [N, 0]
    # In: control points, as for skinning
    motion_in: wp.array2d[float],  # [M, 16]
    reach_in: wp.array2d[float],  # [M, 16]
    aligned: int,  # all shape rotations lie on the same side
    extras: int,  # what the extras change, as of posing; 0: there are none
    indices_in: wp.array2d[wp.int32],  # [N, K]
    weights_in: wp.array2d[float],  # [N, K]
    quats_own_in: wp.array[wp.vec4],  # [N] rotations that correctives and shading follow, touched only with has_own
    has_own: int,
    # Out:
    means_out: wp.array[wp.vec3],  # [N]
    quats_out: wp.array[wp.vec4],  # [N] unit
    scales_out: wp.array[wp.vec3],  # [N]
    opacities_out: wp.array[float],  # [N]
    sh_dc_out: wp.array[wp.vec3],  # [N]
):
    """Pose and activate 16 Gaussians. Grid: ceil(N / 16)."""
    begin = (first + wp.tid()) * _LANES
    pose_block(
        begin, means_in, quats_in, log_scales_in, opacity_logits_in, sh_dc_in, correctives_in, shading_in,
        motion_in, reach_in, aligned, extras, indices_in, weights_in, quats_own_in, has_own,
        means_out, quats_out, scales_out, opacities_out, sh_dc_out,
    )  # fmt: skip
