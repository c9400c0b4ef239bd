"""Candidate nodes for ``nearest_listed``: for each block of sixteen nearby points, a list of the nodes within reach."""

import warp as wp

from ..native import native_function
from ..types import LANES

wp.set_module_options({"enable_backward": False})

LIST_SIZE = wp.constant(192)
"""Largest number of nodes in a block's list. A block with more nodes within reach is searched in full."""

MARGIN = wp.constant(0.15)
"""Extra reach of a list, in units of the distance to the block's farthest neighbour; it leaves room for movements."""


@wp.kernel
def largest_shift(
    first: int,
    # In:
    then_in: wp.array2d[float],  # [M, D]
    nodes_in: wp.array2d[float],  # [M, D]
    # Out:
    shift_out: wp.array[float],  # [1]
):
    """Compute the largest distance that any node has moved, in one grid index.

    Nodes that are non-finite now do not count, because they are never neighbours. A node that was non-finite before and
    is finite now gives infinity.
    """
    most = float(0.0)
    for m in range(nodes_in.shape[0]):
        poison = float(0.0)
        d2 = float(0.0)
        for d in range(nodes_in.shape[1]):
            e = nodes_in[m, d] - then_in[m, d]
            d2 += e * e
            poison += nodes_in[m, d] * 0.0
        if poison == 0.0:
            if wp.isnan(d2):
                most = wp.inf
            elif d2 > most:
                most = d2
    shift_out[first + wp.tid()] = wp.sqrt(most)


@native_function("neighbor_lists.h")
def _list_within(
    block: int, reach: float, centres: wp.array2d[float], columns: wp.array2d[float], counts: wp.array[wp.int32],
    lists: wp.array2d[wp.int32],
): ...  # fmt: skip


@wp.kernel
def morton_codes(
    first: int,
    # In:
    places_in: wp.array2d[float],  # [N, up to 4], most of them in 0 .. 1
    # Out:
    codes_out: wp.array[wp.int32],  # [N]
):
    """Compute the Morton code of place ``i``, in cubes. Places beyond 0 .. 1 count as those at the border."""
    i = first + wp.tid()
    dims = places_in.shape[1]
    levels = 30 / dims
    most = float((1 << levels) - 1)
    code = int(0)
    for d in range(dims):
        cell = places_in[i, d] * most
        bits = int(0)
        if cell > 0.0:
            bits = int(wp.min(cell, most))
        for level in range(levels):
            code = code | (((bits >> level) & 1) << (level * dims + d))
    codes_out[i] = code


@wp.kernel
def list_blocks(
    first: int,
    # In:
    points_in: wp.array2d[float],  # [N, D]
    columns_in: wp.array2d[float],  # [D, M] the nodes, transposed
    order_in: wp.array[wp.int32],  # [N]
    distances_in: wp.array2d[float],  # [N, K] squared
    # Out:
    centres_out: wp.array2d[float],  # [blocks, D + 1]
    counts_out: wp.array[wp.int32],  # [blocks]
    lists_out: wp.array2d[wp.int32],  # [blocks, LIST_SIZE]
):
    """Compute the centre, the reach and the list of nodes of block ``i``."""
    block = first + wp.tid()
    D = points_in.shape[1]
    last = distances_in.shape[1] - 1
    begin = block * LANES
    end = wp.min(begin + LANES, points_in.shape[0])
    for d in range(D):
        low = float(wp.inf)
        high = float(-wp.inf)
        for at in range(begin, end):
            i = order_in[at]
            if distances_in[i, last] < wp.inf:
                low = wp.min(low, points_in[i, d])
                high = wp.max(high, points_in[i, d])
        centres_out[block, d] = 0.5 * low + 0.5 * high  # NaN if no point is finite: nothing is listed
    reach = float(0.0)
    farthest = float(0.0)
    for at in range(begin, end):
        i = order_in[at]
        if distances_in[i, last] < wp.inf:
            d2 = float(0.0)
            for d in range(D):
                e = points_in[i, d] - centres_out[block, d]
                d2 += e * e
            own = wp.sqrt(distances_in[i, last])
            reach = wp.max(reach, wp.sqrt(d2) + own)
            farthest = wp.max(farthest, own)
    reach = wp.min(reach + MARGIN * farthest, 1.0e18)  # its square must not overflow
    centres_out[block, D] = reach
    _list_within(block, reach, centres_out, columns_in, counts_out, lists_out)
