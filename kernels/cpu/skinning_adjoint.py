"""Adjoint of ``skinning.skin_rbf``: a chunk of Gaussians per grid index, sixteen at a time.

A Gaussian's contribution to a node takes one multiply-add of a row, because it is laid out as the palette's motion row:
the outer product ``v (x, 1)^T`` and the gradient of the blended rotation.
"""

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False})


@native_function("skinning_adjoint.h")
def _skin_rbf_adjoint(
    chunk: int, size: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], hyper: wp.array2d[float],
    has_hyper: int, motion: wp.array2d[float], reach: wp.array2d[float], aligned: int, has_strengths: int,
    has_extras: int, indices: wp.array2d[wp.int32], weights: wp.array2d[float], v_means_t: wp.array[wp.vec3],
    v_quats_t: wp.array[wp.vec4], v_extras_t: wp.array[wp.vec3], v_means: wp.array[wp.vec3],
    v_quats: wp.array[wp.vec4], v_hyper: wp.array2d[float], v_motion: wp.array2d[float], v_reach: wp.array2d[float],
): ...  # fmt: skip


@wp.kernel
def skin_rbf_adjoint(
    first: int,
    # In:
    size: int,  # Gaussians a chunk, a multiple of 16 that does not depend on the threads
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N]
    hyper_in: wp.array2d[float],  # [N, H], touched only with has_hyper
    has_hyper: int,
    motion_in: wp.array2d[float],  # [M, 16]
    reach_in: wp.array2d[float],  # [M, 16]
    aligned: int,  # all shape rotations lie on the same side
    has_strengths: int,
    has_extras: int,
    indices_in: wp.array2d[wp.int32],  # [N, K]
    weights_in: wp.array2d[float],  # [N, K]
    v_means_in: wp.array[wp.vec3],  # [N]
    v_quats_in: wp.array[wp.vec4],  # [N]
    v_extras_in: wp.array[wp.vec3],  # [N], touched only with has_extras
    # Out:
    v_means_out: wp.array[wp.vec3],  # [N]
    v_quats_out: wp.array[wp.vec4],  # [N]
    v_hyper_out: wp.array2d[float],  # [N, H], touched only with has_hyper
    v_motion_out: wp.array2d[float],  # [chunks * M, 16]
    v_reach_out: wp.array2d[float],  # [chunks * M, 16]: as reach; v e, v d^2, v, w v_extras of the exponents' v
):
    """Compute the gradients of one chunk of Gaussians, and this chunk's sums for every node."""
    chunk = first + wp.tid()
    _skin_rbf_adjoint(
        chunk, size, means_in, quats_in, hyper_in, has_hyper, motion_in, reach_in, aligned, has_strengths,
        has_extras, indices_in, weights_in, v_means_in, v_quats_in, v_extras_in, v_means_out, v_quats_out,
        v_hyper_out, v_motion_out, v_reach_out,
    )  # fmt: skip
