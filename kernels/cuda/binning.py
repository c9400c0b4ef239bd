"""Binning on CUDA: two radix sorts, parallel on a GPU, order the pairs of tile and splat.

The first sort orders the N splats by depth, with keys of 32 bits. Their pairs are listed in that order, and the second
sort orders the pairs by tile alone, with keys of a dozen bits. Radix sort is stable, so the pairs end up sorted by
tile, then depth, then index. This takes a third of the memory traffic of one sort by keys of tile and depth.

No kernel waits for a count to reach the host. Lists have room for P pairs; unused entries get the number of a tile
beyond the last one, and pairs that do not fit are left out. The caller compares the room with the true total
afterwards. The kernels are plain Warp and run on a CPU too.
"""

from __future__ import annotations

import warp as wp

from ..binning import DEPTH_CULLED, columns_within, rows_within, splat_ellipse, touched_columns, touched_rows

# Counting and emitting must find the same tiles, but the compiler may fuse multiply-adds differently in each kernel.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def count_pairs(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    depths_in: wp.array[float],  # [N]
    radii_in: wp.array[wp.vec2i],  # [N]
    width: int,
    height: int,
    columns: int,
    rows: int,
    tile_size: int,
    tile_begin: int,  # no tile before this one is wanted
    tile_end: int,  # nor this one and those behind it
    # Out:
    counts_out: wp.array[int],  # [N + 1] 0, then the tiles that each splat touches; 0: culled
    depth_keys_out: wp.array[float],  # [2 N] what to sort the splats by, in the first half
    order_out: wp.array[int],  # [2 N] 0, 1, 2, ... in the first half
):
    i = first + wp.tid()
    e = splat_ellipse(means2d_in[i], conics_in[i], opacities_in[i], depths_in[i], radii_in[i])
    count = int(0)
    if e.reach >= 0.0:
        span = rows_within(touched_rows(e, tile_size, rows, height), tile_begin, tile_end, columns)
        for row in range(span[0], span[1]):
            reach = touched_columns(e, row, tile_size, columns, width, height)
            reach = columns_within(reach, row, tile_begin, tile_end, columns)
            count += reach[1] - reach[0]
    key = float(DEPTH_CULLED)
    if count > 0:
        key = depths_in[i] + 0.0  # minus zero becomes zero
    if i == 0:
        counts_out[0] = 0
    counts_out[i + 1] = count
    depth_keys_out[i] = key
    order_out[i] = i


@wp.kernel
def counts_by_depth(
    first: int,
    # In:
    order_in: wp.array[int],  # [2 N] splats by depth in the first half
    counts_in: wp.array[int],  # [N + 1] of ``count_pairs``
    # Out:
    ranked_out: wp.array[int],  # [N + 1] 0, then the count of the splat of each rank
):
    rank = first + wp.tid()
    if rank == 0:
        ranked_out[0] = 0
    ranked_out[rank + 1] = counts_in[order_in[rank] + 1]


@wp.kernel
def emit_by_depth(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    depths_in: wp.array[float],  # [N]
    radii_in: wp.array[wp.vec2i],  # [N]
    order_in: wp.array[int],  # [2 N] splats by depth in the first half
    places_in: wp.array[wp.int64],  # [N + 1] where the pairs of each rank go, if there is room
    room: int,  # P
    offsets_in: wp.array[wp.int64],  # [N + 1] a splat's slots, at most P; empty: slots are not wanted
    width: int,
    height: int,
    columns: int,
    rows: int,
    tile_size: int,
    tile_begin: int,
    tile_end: int,
    # Out:
    tiles_out: wp.array[int],  # [2 P] tile of each pair in the first half; the other half is the sort's own
    values_out: wp.array[int],  # [2 P] slot of each pair, or its splat where slots are not wanted
    owners_out: wp.array[int],  # [P] splat of each slot; empty too
):
    rank = first + wp.tid()
    at = int(wp.min(places_in[rank], wp.int64(room)))
    end = int(wp.min(places_in[rank + 1], wp.int64(room)))
    if at == end:
        return
    i = order_in[rank]
    slot = int(0)
    most = int(0)
    with_slots = offsets_in.shape[0] > 0
    if with_slots:
        slot = int(offsets_in[i])
        most = owners_out.shape[0] - 1
    e = splat_ellipse(means2d_in[i], conics_in[i], opacities_in[i], depths_in[i], radii_in[i])
    span = rows_within(touched_rows(e, tile_size, rows, height), tile_begin, tile_end, columns)
    for row in range(span[0], span[1]):
        reach = touched_columns(e, row, tile_size, columns, width, height)
        reach = columns_within(reach, row, tile_begin, tile_end, columns)
        for column in range(reach[0], reach[1]):
            if at < end:
                tiles_out[at] = row * columns + column
                value = i
                if with_slots:
                    value = wp.min(slot, most)  # pairs share a slot only if there is too little room
                    owners_out[value] = i
                values_out[at] = value
            at += 1
            slot += 1
    while at < end:  # Never runs if both passes find the same tiles; guards against unwritten entries.
        tiles_out[at] = 0
        values_out[at] = i
        if with_slots:
            values_out[at] = wp.min(slot, most)
            owners_out[wp.min(slot, most)] = i
        at += 1
        slot += 1


@wp.kernel
def fill_rest(
    first: int,
    # In:
    places_in: wp.array[wp.int64],  # [N + 1]
    beyond: int,  # a tile after the last
    # Out:
    tiles_out: wp.array[int],  # [2 P]
    values_out: wp.array[int],  # [2 P]
    owners_out: wp.array[int],  # [P] or empty
):
    """Fill entry ``p`` with a key that sorts last if no pair occupies it."""
    p = first + wp.tid()
    if wp.int64(p) >= places_in[places_in.shape[0] - 1]:
        tiles_out[p] = beyond
        values_out[p] = 0
        if owners_out.shape[0] > 0:
            values_out[p] = p
            owners_out[p] = 0


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
def first_of_tile(tiles: wp.array[int], count: int, tile: int) -> int:
    """Return the index of the first sorted pair whose tile is at least ``tile``; ``count`` if there is none."""
    low = int(0)
    high = int(count)
    while low < high:
        middle = low + (high - low) // 2
        if tiles[middle] < tile:
            low = middle + 1
        else:
            high = middle
    return low


@wp.kernel
def tile_ranges(
    first: int,
    # In:
    tiles_in: wp.array[int],  # [2 P] sorted in the first half
    count: int,
    # Out:
    ranges_out: wp.array[wp.vec2i],  # [T]
):
    tile = first + wp.tid()
    ranges_out[tile] = wp.vec2i(first_of_tile(tiles_in, count, tile), first_of_tile(tiles_in, count, tile + 1))
