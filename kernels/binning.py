"""Which tiles each splat touches: count, then emit with the same arithmetic, then the range of each tile.

A splat reaches the pixels where its alpha is at least 1/255, the ellipse ``q <= 2 ln(255 o)``. A tile is touched where
the rectangle of its pixel centres meets that ellipse. Of each row of tiles the touched ones are an interval: the
ellipse cut by the row's slab is convex, so its shadow on the x axis decides exactly, at the price of two roots a row
(the idea of AccuTile, Speedy-Splat, Hanson et al. 2024, section 4).
"""

from __future__ import annotations

import warp as wp

from .types import ALPHA_MIN

# Counting and emitting must find the same tiles: no fusing of multiply and add, which may differ between two kernels.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

DEPTH_CULLED = wp.constant(3.0e38)
"""Sort key of splats that touch nothing; finite, so that a float sort never sees a NaN or an infinity."""

REACH_SLACK = wp.constant(1.0e-3)
"""Added to the ellipse: what float32 rounding may take from q, so that no pixel at the threshold loses its splat."""


@wp.struct
class Ellipse:
    mean: wp.vec2
    reach: float  # q at the edge; negative: the splat is culled
    shear: float  # -B / A
    half_width: float
    half_height: float
    tip: float  # dy of the rightmost point; the leftmost lies at -tip
    spread: float  # reach / A
    steepness: float  # determinant / A^2


@wp.func
def splat_ellipse(mean: wp.vec2, conic: wp.vec3, opacity: float, depth: float, radius: wp.vec2i) -> Ellipse:
    e = Ellipse()
    e.reach = float(-1.0)
    if radius[0] <= 0 or radius[1] <= 0 or not opacity >= ALPHA_MIN:
        return e
    # A sum of finite products is finite unless one of them is not (or so large that the splat is beyond use).
    if not wp.isfinite(mean[0] + mean[1] + conic[0] + conic[1] + conic[2] + opacity + depth):
        return e
    # In float64: of a needle's determinant float32 leaves nothing but rounding.
    determinant = float(wp.float64(conic[0]) * wp.float64(conic[2]) - wp.float64(conic[1]) * wp.float64(conic[1]))
    if determinant > 0.0 and conic[0] > 0.0:
        e.mean = mean
        e.reach = wp.max(2.0 * wp.log(opacity / ALPHA_MIN), 0.0) + REACH_SLACK
        scale = 1.0 / conic[0]
        e.shear = -conic[1] * scale
        e.spread = e.reach * scale
        e.steepness = determinant * scale * scale
        e.half_width = wp.sqrt(e.reach * conic[2] / determinant)
        e.half_height = wp.sqrt(e.reach * conic[0] / determinant)
        e.tip = -conic[1] * wp.sqrt(e.reach / (conic[2] * determinant))
    return e


@wp.func
def touched(low: float, high: float, tile_size: int, tiles: int, extent: int) -> wp.vec2i:
    """Begin and end of the tiles, along one axis, whose pixel centres' span meets [low, high]."""
    if not (high >= 0.5 and low <= float(extent) - 0.5):
        return wp.vec2i(0, 0)
    scale = 1.0 / float(tile_size)
    begin = int((wp.max(low, 0.5) - 0.5) * scale)
    if low > float((begin + 1) * tile_size) - 0.5:
        begin += 1  # between this tile's last pixel centre and the next one's first
    end = int((wp.min(high, float(extent)) - 0.5) * scale) + 1
    return wp.vec2i(begin, wp.clamp(end, begin, tiles))


@wp.func
def touched_rows(e: Ellipse, tile_size: int, rows: int, height: int) -> wp.vec2i:
    return touched(e.mean[1] - e.half_height, e.mean[1] + e.half_height, tile_size, rows, height)


@wp.func
def touched_columns(e: Ellipse, row: int, tile_size: int, columns: int, width: int, height: int) -> wp.vec2i:
    # The slab of the row's pixel centres, cut to the ellipse; it may cut off either tip.
    low = wp.max(float(row * tile_size) + 0.5 - e.mean[1], -e.half_height)
    high = wp.min(float(wp.min((row + 1) * tile_size, height)) - 0.5 - e.mean[1], e.half_height)
    right = wp.clamp(e.tip, low, high)
    left = wp.clamp(-e.tip, low, high)
    # q = reach, solved for dx.
    x_right = e.shear * right + wp.sqrt(wp.max(e.spread - e.steepness * right * right, 0.0))
    x_left = e.shear * left - wp.sqrt(wp.max(e.spread - e.steepness * left * left, 0.0))
    return touched(e.mean[0] + x_left, e.mean[0] + x_right, tile_size, columns, width)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffsll(mask) - 1;
#else
    return __builtin_ctzll(mask);
#endif
""")
def lowest_bit(mask: wp.uint64) -> int: ...


@wp.kernel
def count_tiles(
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
    # Out:
    counts_out: wp.array[int],  # [N] tiles touched; 0: culled
    corners_out: wp.array[int],  # [N] first tile of a window of 8 x 8
    windows_out: wp.array[wp.int64],  # [N] the tiles touched there, a bit each; 0: they do not fit
    depth_keys_out: wp.array[float],  # [2 N] what to sort the splats by, in the first half; empty: not wanted
    order_out: wp.array[int],  # [2 N] 0, 1, 2, ... in the first half; empty too
):
    i = first + wp.tid()
    e = splat_ellipse(means2d_in[i], conics_in[i], opacities_in[i], depths_in[i], radii_in[i])
    count = int(0)
    corner = int(0)
    window = wp.uint64(0)
    if e.reach >= 0.0:
        span = touched_rows(e, tile_size, rows, height)
        left = touched(e.mean[0] - e.half_width, e.mean[0] + e.half_width, tile_size, columns, width)[0]
        fits = span[1] - span[0] <= 8
        corner = span[0] * columns + left
        for row in range(span[0], span[1]):
            reach = touched_columns(e, row, tile_size, columns, width, height)
            length = reach[1] - reach[0]
            count += length
            if length > 0:
                fits = fits and reach[0] >= left and reach[1] <= left + 8
                if fits:
                    bits = (wp.uint64(1) << wp.uint64(length)) - wp.uint64(1)
                    window = window | (bits << wp.uint64((row - span[0]) * 8 + reach[0] - left))
        if not fits:
            window = wp.uint64(0)
    counts_out[i] = count
    corners_out[i] = corner
    windows_out[i] = wp.int64(window)
    if order_out.shape[0] > 0:
        key = float(DEPTH_CULLED)
        if count > 0:
            key = depths_in[i]
        depth_keys_out[i] = key
        order_out[i] = i


@wp.kernel
def scan_counts(
    first: int,
    # In:
    counts_in: wp.array[int],  # [N]
    # Out:
    offsets_out: wp.array[wp.int64],  # [N + 1] sum of the counts before each
):
    """In one grid index, for a CPU, where torch would start its threads for it."""
    total = wp.int64(0)
    for i in range(counts_in.shape[0]):
        offsets_out[i] = total
        total += wp.int64(counts_in[i])
    offsets_out[counts_in.shape[0]] = total


@wp.kernel
def emit_pairs(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    depths_in: wp.array[float],  # [N]
    radii_in: wp.array[wp.vec2i],  # [N]
    offsets_in: wp.array[wp.int64],  # [N + 1] a splat's slots
    corners_in: wp.array[int],  # [N]
    windows_in: wp.array[wp.int64],  # [N] what count_tiles found, where it fits; else it is found again
    width: int,
    height: int,
    columns: int,
    rows: int,
    tile_size: int,
    # Out:
    tiles_out: wp.array[int],  # [P] tile of each slot
):
    i = first + wp.tid()
    slot = int(offsets_in[i])
    end = int(offsets_in[i + 1])
    window = wp.uint64(windows_in[i])
    corner = corners_in[i]
    while window != wp.uint64(0):
        bit = lowest_bit(window)
        window = window & (window - wp.uint64(1))
        tiles_out[slot] = corner + (bit >> 3) * columns + (bit & 7)
        slot += 1
    if slot < end:
        e = splat_ellipse(means2d_in[i], conics_in[i], opacities_in[i], depths_in[i], radii_in[i])
        span = touched_rows(e, tile_size, rows, height)
        for row in range(span[0], span[1]):
            reach = touched_columns(e, row, tile_size, columns, width, height)
            for column in range(reach[0], reach[1]):
                if slot < end:
                    tiles_out[slot] = row * columns + column
                slot += 1
        while slot < end:  # never, as long as both passes find the same tiles; but no slot may stay unwritten
            tiles_out[slot] = corner
            slot += 1


@wp.kernel
def place_pairs(
    first: int,
    # In:
    order_in: wp.array[int],  # [2 N] splats by depth in the first half
    offsets_in: wp.array[wp.int64],  # [N + 1] a splat's slots
    tiles_in: wp.array[int],  # [P] tile of each slot
    # Out:
    cursors_out: wp.array[int],  # [T] scratch
    ranges_out: wp.array[wp.vec2i],  # [T]
    splats_out: wp.array[int],  # [P] sorted by tile, then depth
    slots_out: wp.array[int],  # [P]
):
    """Counting sort by tile of splats that are sorted by depth, for a CPU: one grid index does it all, because three
    walks over the pairs are faster than a radix sort that could be shared."""
    for tile in range(cursors_out.shape[0]):
        cursors_out[tile] = 0
    for slot in range(tiles_in.shape[0]):
        cursors_out[tiles_in[slot]] = cursors_out[tiles_in[slot]] + 1
    begin = int(0)
    for tile in range(cursors_out.shape[0]):
        end = begin + cursors_out[tile]
        ranges_out[tile] = wp.vec2i(begin, end)
        cursors_out[tile] = begin
        begin = end
    for rank in range(offsets_in.shape[0] - 1):
        i = order_in[rank]
        for slot in range(int(offsets_in[i]), int(offsets_in[i + 1])):
            tile = tiles_in[slot]
            p = cursors_out[tile]
            cursors_out[tile] = p + 1
            splats_out[p] = i
            slots_out[p] = slot
