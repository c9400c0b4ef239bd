"""Binning on a CPU: splats are distributed to rows of tiles, and each row is sorted separately.

A *band* is a row of tiles; a *stretch* is the interval of a band's columns that one splat touches. Splats are turned
into stretches in index order, which reads memory sequentially, and distributed to their bands. The stretches of one
band fit into a core's own cache, where they are sorted by depth and written tile by tile. There are four launches; all
but the second are shared among threads:

1. ``count_chunks`` finds the tiles that each splat touches, 16 splats at a time, and counts the stretches that a chunk
   of splats has in each band.
2. ``place_chunks`` turns these counts into running sums, the positions at which each chunk writes.
3. ``deal_chunks`` writes the stretches by band, within a band in the order of the splats' indices.
4. ``sort_bands`` sorts each band by depth with a stable radix sort, then fills its tiles' lists by counting.

The order by tile, depth and index is unique, so results do not depend on the number of chunks or threads. Native code
repeats the arithmetic of ``binning`` operation by operation, so that a CPU and a GPU find the same tiles.
"""

from __future__ import annotations

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


# fmt: off
@native_function("binning.h")
def count_chunk(
    chunk: int, means2d: wp.array[wp.vec2], conics: wp.array[wp.vec3], opacities: wp.array[float],
    depths: wp.array[float], radii: wp.array[wp.vec2i], chunk_size: int, width: int, height: int, columns: int,
    rows: int, tile_size: int, tile_begin: int, tile_end: int, windows: wp.array[wp.int64],
    corners: wp.array[wp.vec2i], stretches_of_chunk: wp.array2d[int], pairs_of_chunk: wp.array[wp.int64],
): ...


@native_function("binning.h")
def deal_chunk(
    chunk: int, means2d: wp.array[wp.vec2], conics: wp.array[wp.vec3], opacities: wp.array[float],
    depths: wp.array[float], chunk_size: int, width: int, height: int, columns: int, rows: int, tile_size: int,
    tile_begin: int, tile_end: int, windows: wp.array[wp.int64], corners: wp.array[wp.vec2i],
    first_slots: wp.array[wp.int64], cursors_of_chunk: wp.array2d[int], offsets: wp.array[wp.int64],
    stretches: wp.array2d[int], keys: wp.array[wp.int64], pairs_before: wp.array2d[int],
): ...


@native_function("binning.h")
def sort_band(
    band: int, band_begins: wp.array[int], stretches: wp.array2d[int], pairs_before: wp.array2d[int],
    keys: wp.array[wp.int64], spare: wp.array[wp.int64], cursors: wp.array2d[int], ranges: wp.array[wp.vec2i],
    splats: wp.array[int], slots: wp.array[int],
): ...
# fmt: on


@wp.kernel
def count_chunks(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    depths_in: wp.array[float],  # [N]
    radii_in: wp.array[wp.vec2i],  # [N]
    chunk_size: int,  # a multiple of 16
    width: int,
    height: int,
    columns: int,
    rows: int,
    tile_size: int,
    tile_begin: int,  # no tile before this one is wanted
    tile_end: int,  # nor this one and those behind it
    # Out:
    windows_out: wp.array[wp.int64],  # [N] tiles touched in a window of 8 x 8, a byte a row; else the last row
    corners_out: wp.array[wp.vec2i],  # [N] first row, first column; column -1: the tiles do not fit into the window
    stretches_out: wp.array2d[int],  # [chunks, bands + 1] stretches of the chunk in each band; the last is 0
    pairs_out: wp.array[wp.int64],  # [chunks + 2] pairs of the chunk
):
    count_chunk(
        first + wp.tid(), means2d_in, conics_in, opacities_in, depths_in, radii_in, chunk_size, width, height, columns,
        rows, tile_size, tile_begin, tile_end, windows_out, corners_out, stretches_out, pairs_out,
    )  # fmt: skip


@wp.kernel
def place_chunks(
    first: int,
    # Out:
    stretches_out: wp.array2d[int],  # [chunks, bands + 1] counts, becomes: where the chunk's first goes
    pairs_out: wp.array[wp.int64],  # [chunks + 2] counts, becomes: pairs before the chunk; all pairs; all stretches
    band_begins_out: wp.array[int],  # [bands + 1]
):
    """Turn counts into running sums. One grid index does it all, since there is little to add up."""
    chunks = stretches_out.shape[0]
    stretches = wp.int64(0)
    for band in range(band_begins_out.shape[0]):
        band_begins_out[band] = int(stretches)
        for chunk in range(chunks):
            own = stretches_out[chunk, band]
            stretches_out[chunk, band] = int(stretches)
            stretches += wp.int64(own)
    pairs = wp.int64(0)
    for chunk in range(chunks):
        of_chunk = pairs_out[chunk]
        pairs_out[chunk] = pairs
        pairs += of_chunk
    pairs_out[chunks] = pairs
    pairs_out[chunks + 1] = stretches


@wp.kernel
def deal_chunks(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    depths_in: wp.array[float],  # [N]
    chunk_size: int,
    width: int,
    height: int,
    columns: int,
    rows: int,
    tile_size: int,
    tile_begin: int,
    tile_end: int,
    windows_in: wp.array[wp.int64],  # [N]
    corners_in: wp.array[wp.vec2i],  # [N]
    first_slots_in: wp.array[wp.int64],  # [chunks + 2] pairs before the chunk
    # Out:
    cursors_out: wp.array2d[int],  # [chunks, bands + 1] where the chunk's first stretch of a band goes; scratch
    offsets_out: wp.array[wp.int64],  # [N + 1] a splat's slots
    stretches_out: wp.array2d[int],  # [R, 4] splat, first slot, begin and end of the columns
    keys_out: wp.array[wp.int64],  # [R] depth << 32 | index of the stretch
    pairs_out: wp.array2d[int],  # [chunks, bands + 1] pairs of the chunk in earlier bands
):
    deal_chunk(
        first + wp.tid(), means2d_in, conics_in, opacities_in, depths_in, chunk_size, width, height, columns, rows,
        tile_size, tile_begin, tile_end, windows_in, corners_in, first_slots_in, cursors_out, offsets_out,
        stretches_out, keys_out, pairs_out,
    )  # fmt: skip


@wp.kernel
def sort_bands(
    first: int,
    # In:
    band_begins_in: wp.array[int],  # [bands + 1]
    stretches_in: wp.array2d[int],  # [R, 4] splat, first slot, begin and end of the columns
    pairs_before_in: wp.array2d[int],  # [chunks, bands + 1] pairs of the chunk in earlier bands
    # Out:
    keys_out: wp.array[wp.int64],  # [R] depth << 32 | index of the stretch; scratch
    spare_out: wp.array[wp.int64],  # [R] scratch
    cursors_out: wp.array2d[int],  # [bands, columns] scratch
    ranges_out: wp.array[wp.vec2i],  # [T]
    splats_out: wp.array[int],  # [P] sorted by tile, then depth
    slots_out: wp.array[int],  # [P]
):
    sort_band(
        first + wp.tid(), band_begins_in, stretches_in, pairs_before_in, keys_out, spare_out, cursors_out, ranges_out,
        splats_out, slots_out,
    )  # fmt: skip
