"""Search for the K nearest control points on a CPU: a block of sixteen points per grid index, a point per SIMD lane.

``nearest`` searches all nodes. ``nearest_listed`` searches only a list of nodes: those that were within ``reach`` of
the block's centre c when ``list_blocks`` ran, for blocks of sixteen Gaussians that lie close together. It also proves
that no other node matters. Every node outside the list was at least ``reach`` away from c, and has come closer by at
most ``shift``, the largest movement of any node since. Therefore, if ``|x - c| + d_K + shift < reach`` for point x and
its K-th distance d_K, its K nearest nodes are in the list. If this fails for any lane, the block is searched in full.
Both kernels visit nodes in ascending order, compute distances by the same expression and insert on a strict ``<``, so
their indices are the same, ties included, whatever the lists.
"""

import warp as wp

from ..native import native_function
from ..types import LANES
from ..types import MAX_DIMENSIONS as MAX_DIMENSIONS

wp.set_module_options({"enable_backward": False})


@native_function("neighbors.h")
def _nearest(
    begin: int,
    K: int,
    points: wp.array2d[float],
    nodes: wp.array2d[float],
    indices: wp.array2d[wp.int32],
    distances: wp.array2d[float],
): ...


@native_function("neighbors.h")
def _nearest_listed(
    block: int, K: int, points: wp.array2d[float], nodes: wp.array2d[float], order: wp.array[wp.int32],
    centres: wp.array2d[float], counts: wp.array[wp.int32], lists: wp.array2d[wp.int32], shift: wp.array[float],
    indices: wp.array2d[wp.int32], failed: wp.array[wp.int32],
): ...  # fmt: skip


@wp.kernel
def nearest(
    first: int,
    # In:
    points_in: wp.array2d[float],  # [N, D], D <= MAX_DIMENSIONS
    nodes_in: wp.array2d[float],  # [M, D]
    K: int,  # <= MAX_NEIGHBORS
    # Out:
    indices_out: wp.array2d[wp.int32],  # [N, K] nearest first
    distances_out: wp.array2d[float],  # [N, K] squared
):
    """Find the K nearest nodes of points ``16 i .. 16 i + 15``."""
    block = first + wp.tid()
    _nearest(block * LANES, K, points_in, nodes_in, indices_out, distances_out)


@wp.kernel
def nearest_listed(
    first: int,
    # In:
    points_in: wp.array2d[float],  # [N, D], D <= MAX_DIMENSIONS
    nodes_in: wp.array2d[float],  # [M, D]
    K: int,  # <= MAX_NEIGHBORS
    order_in: wp.array[wp.int32],  # [N] points of block i: order[16 i ..]
    centres_in: wp.array2d[float],  # [blocks, D + 1] centre, then how far the list reaches
    counts_in: wp.array[wp.int32],  # [blocks] nodes in the list, -1 where there is none
    lists_in: wp.array2d[wp.int32],  # [blocks, room] ascending
    shift_in: wp.array[float],  # [1] largest shift of a node since the lists were made
    # Out:
    indices_out: wp.array2d[wp.int32],  # [N, K] nearest first
    failed_out: wp.array[wp.int32],  # [blocks] 1 where the list did not suffice
):
    """Find the exact K nearest nodes of the points of block ``i``."""
    block = first + wp.tid()
    _nearest_listed(
        block, K, points_in, nodes_in, order_in, centres_in, counts_in, lists_in, shift_in, indices_out, failed_out
    )
