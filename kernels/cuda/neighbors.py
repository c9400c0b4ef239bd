"""Search for the K nearest control points on CUDA, for K of at most 4 and at most 12 dimensions.

``neighbors.nearest`` keeps its sorted list in global memory, because the list is indexed by a variable. Here each
thread keeps the four nearest nodes in registers; the first K of them are the K nearest. Nodes are staged through shared
memory, padded with zeros to a multiple of four dimensions, because one read of 16 bytes then replaces four: threads
that read the same address share one read, but each read occupies the load unit as long as two or three instructions of
arithmetic take. Nodes come in ascending order and enter the list on a strict ``<``, so ties go to the lower index.

On a CPU the native function is empty; tests compile it with a shim that runs a block's threads as fibres.
"""

from __future__ import annotations

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False})

BLOCK_DIM = 256
MAX_NEIGHBORS = 4
MAX_DIMENSIONS = 12


@native_function("neighbors_cuda.h", device="cuda")
def nearest_of_block(
    block: int,
    points: wp.array2d[float],
    nodes: wp.array2d[float],
    K: int,
    indices: wp.array2d[wp.int32],
    distances: wp.array2d[float],
): ...


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
    """Find the K nearest nodes of 256 points per block. Grid: ceil(N / 256) x 256."""
    block, _lane = wp.tid()
    nearest_of_block(first + block, points_in, nodes_in, K, indices_out, distances_out)
