"""RBF weights and skinning in one pass, for CPUs: sixteen Gaussians a step, SIMD in native bodies.

The same mathematics as ``rbf_weights`` and ``skin``, which stay the readable truth, over the rows of
``skinning_palette.py``: blending is one multiply-add of a whole row a neighbour. ``skin`` takes weights that are
known, as they are when a scene is rendered; ``skinning_cpu_adjoint.py`` has the gradients.
"""

import warp as wp

from ..native import native_function
from ..neighbors import MAX_NEIGHBORS as MAX_NEIGHBORS

wp.set_module_options({"enable_backward": False})

LANES = 16


@native_function("skinning.h")
def _skin(
    begin: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], motion: wp.array2d[float],
    reach: wp.array2d[float], aligned: int, has_log_scales: int, indices: wp.array2d[wp.int32],
    weights: wp.array2d[float], means_t: wp.array[wp.vec3], quats_t: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
): ...  # fmt: skip


@native_function("skinning.h")
def _skin_rbf(
    begin: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], hyper: wp.array2d[float], has_hyper: int,
    motion: wp.array2d[float], reach: wp.array2d[float], aligned: int, has_strengths: int, has_log_scales: int,
    indices: wp.array2d[wp.int32], weights: wp.array2d[float], means_t: wp.array[wp.vec3],
    quats_t: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
): ...  # fmt: skip


@wp.kernel
def skin(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N]
    motion_in: wp.array2d[float],  # [M, 16]
    reach_in: wp.array2d[float],  # [M, 16]
    aligned: int,  # all shape rotations lie on the same side
    has_log_scales: int,
    indices_in: wp.array2d[wp.int32],  # [N, K]
    weights_in: wp.array2d[float],  # [N, K]
    # Out:
    means_out: wp.array[wp.vec3],  # [N]
    quats_out: wp.array[wp.vec4],  # [N]
    log_scales_out: wp.array[wp.vec3],  # [N], touched only with has_log_scales
):
    """Gaussians ``16 i .. 16 i + 15``, with weights that are known."""
    begin = (first + wp.tid()) * LANES
    _skin(
        begin, means_in, quats_in, motion_in, reach_in, aligned, has_log_scales, indices_in, weights_in,
        means_out, quats_out, log_scales_out,
    )  # fmt: skip


@wp.kernel
def skin_rbf(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N]
    hyper_in: wp.array2d[float],  # [N, H], touched only with has_hyper
    has_hyper: int,
    motion_in: wp.array2d[float],  # [M, 16]
    reach_in: wp.array2d[float],  # [M, 16]
    aligned: int,  # all shape rotations lie on the same side
    has_strengths: int,
    has_log_scales: int,
    indices_in: wp.array2d[wp.int32],  # [N, K]
    # Out:
    weights_out: wp.array2d[float],  # [N, K]
    means_out: wp.array[wp.vec3],  # [N]
    quats_out: wp.array[wp.vec4],  # [N]
    log_scales_out: wp.array[wp.vec3],  # [N], touched only with has_log_scales
):
    """Gaussians ``16 i .. 16 i + 15``."""
    begin = (first + wp.tid()) * LANES
    _skin_rbf(
        begin, means_in, quats_in, hyper_in, has_hyper, motion_in, reach_in, aligned, has_strengths,
        has_log_scales, indices_in, weights_out, means_out, quats_out, log_scales_out,
    )  # fmt: skip
