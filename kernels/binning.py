"""Which tiles each splat touches: count, then emit with the same arithmetic, then the range of each tile.

A splat reaches the pixels where its alpha is at least 1/255, the ellipse ``q <= 2 ln(255 o)``. A tile is touched where
the rectangle of its pixel centres meets that ellipse. Of each row of tiles the touched ones are an interval: the
ellipse cut by the row's slab is convex, so its shadow on the x axis decides exactly, at the price of two roots a row
(the idea of AccuTile, Speedy-Splat, Hanson et al. 2024, section 4).
"""

from __future__ import annotations

import warp as wp

from .types import ALPHA_MIN

wp.set_module_options({"enable_backward": False})

DEPTH_CULLED = wp.constant(3.0e38)
"""Sort key of splats that touch nothing; finite, so that a float sort never sees a NaN or an infinity."""

Q_SLACK = wp.constant(1.0e-3)
"""Added to the ellipse: what float32 rounding may take from q, so that no pixel at the threshold loses its splat."""


@wp.struct
class Ellipse:
    mean: wp.vec2
    conic: wp.vec3
    determinant: float
    q: float  # squared size of the ellipse; negative: the splat is culled


@wp.func
def splat_ellipse(mean: wp.vec2, conic: wp.vec3, opacity: float, depth: float, radius: wp.vec2i) -> Ellipse:
    e = Ellipse()
    e.mean = mean
    e.conic = conic
    e.q = float(-1.0)
    finite = wp.isfinite(mean) and wp.isfinite(conic) and wp.isfinite(opacity) and wp.isfinite(depth)
    if finite and radius[0] > 0 and radius[1] > 0 and opacity >= ALPHA_MIN:
        # In float64: of a needle's determinant float32 leaves nothing but rounding.
        determinant = float(wp.float64(conic[0]) * wp.float64(conic[2]) - wp.float64(conic[1]) * wp.float64(conic[1]))
        if determinant > 0.0 and conic[0] > 0.0 and conic[2] > 0.0:
            e.determinant = determinant
            e.q = wp.max(2.0 * wp.log(opacity / ALPHA_MIN), 0.0) + Q_SLACK
    return e


@wp.func
def touched(low: float, high: float, tile_size: int, tiles: int, extent: int) -> wp.vec2i:
    """Begin and end of the tiles, along one axis, whose pixel centres' span meets [low, high]."""
    begin = int(0)
    end = int(0)
    if high >= 0.5 and low <= float(extent) - 0.5:
        size = float(tile_size)
        begin = int(wp.clamp(wp.ceil((low - size + 0.5) / size), 0.0, float(tiles)))
        end = int(wp.clamp(wp.floor((high - 0.5) / size) + 1.0, 0.0, float(tiles)))
    return wp.vec2i(begin, wp.max(begin, end))


@wp.func
def touched_rows(e: Ellipse, tile_size: int, rows: int, height: int) -> wp.vec2i:
    half = wp.sqrt(e.q * e.conic[0] / e.determinant)
    return touched(e.mean[1] - half, e.mean[1] + half, tile_size, rows, height)


@wp.func
def touched_columns(e: Ellipse, row: int, tile_size: int, columns: int, width: int, height: int) -> wp.vec2i:
    a = e.conic[0]
    b = e.conic[1]
    half = wp.sqrt(e.q * a / e.determinant)
    low = wp.max(float(row * tile_size) + 0.5 - e.mean[1], -half)
    high = wp.min(float(wp.min((row + 1) * tile_size, height)) - 0.5 - e.mean[1], half)
    # The ellipse's rightmost point lies at this dy, the leftmost at its negative; the slab may cut either off.
    tip = -b / e.conic[2] * wp.sqrt(e.q * e.conic[2] / e.determinant)
    right = wp.clamp(tip, low, high)
    left = wp.clamp(-tip, low, high)
    x_right = (wp.sqrt(wp.max(e.q * a - e.determinant * right * right, 0.0)) - b * right) / a
    x_left = (-wp.sqrt(wp.max(e.q * a - e.determinant * left * left, 0.0)) - b * left) / a
    return touched(e.mean[0] + x_left, e.mean[0] + x_right, tile_size, columns, width)


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
    keys_out: wp.array[float],  # [2 N] depth in the first half, what to sort by; the other half is the sort's own
    order_out: wp.array[int],  # [2 N] the splat's index in the first half
):
    i = first + wp.tid()
    e = splat_ellipse(means2d_in[i], conics_in[i], opacities_in[i], depths_in[i], radii_in[i])
    count = int(0)
    if e.q >= 0.0:
        span = touched_rows(e, tile_size, rows, height)
        for row in range(span[0], span[1]):
            reach = touched_columns(e, row, tile_size, columns, width, height)
            count += reach[1] - reach[0]
    counts_out[i] = count
    key = DEPTH_CULLED
    if count > 0:
        key = depths_in[i]
    keys_out[i] = key
    order_out[i] = i


@wp.kernel
def gather_counts(
    first: int,
    # In:
    counts_in: wp.array[int],  # [N]
    order_in: wp.array[int],  # [2 N] splats by depth in the first half
    # Out:
    counts_out: wp.array[int],  # [N] the same, nearest splat first
):
    rank = first + wp.tid()
    counts_out[rank] = counts_in[order_in[rank]]


@wp.kernel
def emit_pairs(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    depths_in: wp.array[float],  # [N]
    radii_in: wp.array[wp.vec2i],  # [N]
    order_in: wp.array[int],  # [2 N] splats by depth in the first half
    offsets_in: wp.array[wp.int64],  # [N + 1] a splat's slots
    ends_in: wp.array[wp.int64],  # [N] by depth rank: end of the splat's pairs in the list to sort
    width: int,
    height: int,
    columns: int,
    rows: int,
    tile_size: int,
    # Out:
    tiles_out: wp.array[int],  # [2 P] tile of each pair, nearest splat first, in the first half
    slots_out: wp.array[int],  # [2 P] slot of each pair, in the first half
    owners_out: wp.array[int],  # [P] splat of each slot
):
    rank = first + wp.tid()
    i = order_in[rank]
    slot = int(offsets_in[i])
    count = int(offsets_in[i + 1]) - slot
    if count == 0:
        return
    position = int(ends_in[rank]) - count
    e = splat_ellipse(means2d_in[i], conics_in[i], opacities_in[i], depths_in[i], radii_in[i])
    span = touched_rows(e, tile_size, rows, height)
    for row in range(span[0], span[1]):
        reach = touched_columns(e, row, tile_size, columns, width, height)
        for column in range(reach[0], reach[1]):
            tiles_out[position] = row * columns + column
            slots_out[position] = slot
            owners_out[slot] = i
            position += 1
            slot += 1


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
def lower_bound(keys: wp.array[int], count: int, key: int) -> int:
    low = int(0)
    high = int(count)
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
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
    ranges_out[tile] = wp.vec2i(lower_bound(tiles_in, count, tile), lower_bound(tiles_in, count, tile + 1))
