"""Sorting the pairs of tile and splat by one radix sort, which a GPU can share among its threads."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def sortable(depth: float) -> wp.int64:
    """The bits of a float, turned so that they sort as unsigned integers in the float's order."""
    bits = wp.cast(depth + 0.0, wp.uint32)  # + 0: minus zero becomes zero
    sign = wp.uint32(1) << wp.uint32(31)
    if (bits & sign) != wp.uint32(0):
        bits = ~bits
    else:
        bits = bits | sign
    return wp.int64(bits)


@wp.kernel
def pair_keys(
    first: int,
    # In:
    depths_in: wp.array[float],  # [N]
    offsets_in: wp.array[wp.int64],  # [N + 1] a splat's slots
    tiles_in: wp.array[int],  # [P] tile of each slot
    # Out:
    keys_out: wp.array[wp.int64],  # [2 P] tile << 32 | depth in the first half; the other half is the sort's own
    slots_out: wp.array[int],  # [2 P] 0, 1, 2, ... in the first half
    owners_out: wp.array[int],  # [P] splat of each slot
):
    i = first + wp.tid()
    depth = sortable(depths_in[i])
    for slot in range(int(offsets_in[i]), int(offsets_in[i + 1])):
        keys_out[slot] = (wp.int64(tiles_in[slot]) << wp.int64(32)) | depth
        slots_out[slot] = slot
        owners_out[slot] = i


@wp.kernel
def gather_owners(
    first: int,
    # In:
    slots_in: wp.array[int],  # [2 P] sorted by tile, then depth, in the first half
    owners_in: wp.array[int],  # [P] splat of each slot
    # Out:
    splats_out: wp.array[int],  # [P]
):
    p = first + wp.tid()
    splats_out[p] = owners_in[slots_in[p]]


@wp.func
def first_of_tile(keys: wp.array[wp.int64], count: int, tile: int) -> int:
    """Where the sorted pairs of a tile, or of a later one, begin."""
    key = wp.int64(tile) << wp.int64(32)
    low = int(0)
    high = int(count)
    while low < high:
        middle = low + (high - low) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@wp.kernel
def tile_ranges(
    first: int,
    # In:
    keys_in: wp.array[wp.int64],  # [2 P] sorted in the first half
    count: int,
    # Out:
    ranges_out: wp.array[wp.vec2i],  # [T]
):
    tile = first + wp.tid()
    ranges_out[tile] = wp.vec2i(first_of_tile(keys_in, count, tile), first_of_tile(keys_in, count, tile + 1))
