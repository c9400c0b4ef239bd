"""Skinning on a CPU, with known weights (``skin``) or with RBF weights in the same pass (``skin_rbf``).

Sixteen Gaussians are moved at a time, one in each SIMD lane. The formulas are those of ``neighbors.rbf_weights`` and
``skinning.skin``. Control points are stored as the rows of ``skinning_palette.py``, so blending takes one multiply-add
of a whole row per neighbour. Rendering a trained scene uses known weights, without an adjoint; the adjoint of
``skin_rbf`` is in ``skinning_adjoint.py``.
"""

import warp as wp

from ..native import native_function
from ..neighbors import MAX_NEIGHBORS as MAX_NEIGHBORS
from ..types import LANES

wp.set_module_options({"enable_backward": False})


@native_function("skinning.h")
def _skin(
    begin: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], motion: wp.array2d[float],
    reach: wp.array2d[float], aligned: int, has_extras: int, indices: wp.array2d[wp.int32],
    weights: wp.array2d[float], means_t: wp.array[wp.vec3], quats_t: wp.array[wp.vec4],
    extras: wp.array[wp.vec3],
): ...  # fmt: skip


@native_function("skinning.h")
def _skin_rbf(
    begin: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], hyper: wp.array2d[float], has_hyper: int,
    motion: wp.array2d[float], reach: wp.array2d[float], aligned: int, has_strengths: int, has_extras: int,
    indices: wp.array2d[wp.int32], weights: wp.array2d[float], means_t: wp.array[wp.vec3],
    quats_t: wp.array[wp.vec4], extras: wp.array[wp.vec3],
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
    has_extras: int,
    indices_in: wp.array2d[wp.int32],  # [N, K]
    weights_in: wp.array2d[float],  # [N, K]
    # Out:
    means_out: wp.array[wp.vec3],  # [N]
    quats_out: wp.array[wp.vec4],  # [N]
    extras_out: wp.array[wp.vec3],  # [N], touched only with has_extras
):
    """Move Gaussians ``16 i .. 16 i + 15`` with known weights."""
    begin = (first + wp.tid()) * LANES
    _skin(
        begin, means_in, quats_in, motion_in, reach_in, aligned, has_extras, indices_in, weights_in,
        means_out, quats_out, extras_out,
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
    has_extras: int,
    indices_in: wp.array2d[wp.int32],  # [N, K]
    # Out:
    weights_out: wp.array2d[float],  # [N, K]
    means_out: wp.array[wp.vec3],  # [N]
    quats_out: wp.array[wp.vec4],  # [N]
    extras_out: wp.array[wp.vec3],  # [N], touched only with has_extras
):
    """Compute the weights of Gaussians ``16 i .. 16 i + 15`` and move them."""
    begin = (first + wp.tid()) * LANES
    _skin_rbf(
        begin, means_in, quats_in, hyper_in, has_hyper, motion_in, reach_in, aligned, has_strengths,
        has_extras, indices_in, weights_out, means_out, quats_out, extras_out,
    )  # fmt: skip
