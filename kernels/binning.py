"""Geometry of the tiles that a splat touches, shared by the sorts in ``cpu/binning.py`` and ``cuda/binning.py``.

A splat reaches the pixels where its alpha is at least 1/255, the ellipse ``q <= 2 ln(255 o)``. It touches a tile if the
rectangle of the tile's pixel centres meets that ellipse. The ellipse is convex, so the tiles that it touches in a row
of tiles form an interval: the projection onto the x axis of the part within the row. Computing it exactly takes two
square roots per row (the idea of AccuTile, Speedy-Splat, Hanson et al. 2024, section 4).
"""

from __future__ import annotations

import warp as wp

from .types import ALPHA_MIN

# Counting and emitting must find the same tiles, but the compiler may fuse multiply-adds differently in each kernel.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

DEPTH_CULLED = wp.constant(3.0e38)
"""Sort key of splats that touch no tile. It is finite, so that no sort has to order a NaN or an infinity."""

REACH_SLACK = wp.constant(1.0e-3)
"""Slack added to the bound on q against rounding in float32, so that no pixel at the threshold loses its splat."""

LOG2_COEFFICIENTS = (1.4426933, -0.72116273, 0.47770593, -0.33924777, 0.21558853, -0.096066249, 0.020490346)
"""Coefficients of log2(1 + m) / m on [0, 1], lowest power first, fitted at Chebyshev points; log2 is right to 2e-6."""

LOG2_0, LOG2_1, LOG2_2, LOG2_3, LOG2_4, LOG2_5, LOG2_6 = (wp.constant(value) for value in LOG2_COEFFICIENTS)


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
def reach_of(opacity: float) -> float:
    """Compute ``2 ln(255 o)``, at least 0, plus slack. Library logarithms would round differently on each device."""
    bits = wp.cast(opacity / ALPHA_MIN, wp.uint32)
    m = wp.cast((bits & wp.uint32(0x7FFFFF)) | wp.uint32(0x3F800000), float) - 1.0
    log2 = float(LOG2_6)
    log2 = log2 * m + LOG2_5
    log2 = log2 * m + LOG2_4
    log2 = log2 * m + LOG2_3
    log2 = log2 * m + LOG2_2
    log2 = log2 * m + LOG2_1
    log2 = log2 * m + LOG2_0
    log2 = log2 * m + float(int(bits >> wp.uint32(23)) - 127)
    return wp.max(1.3862943611198906 * log2, 0.0) + REACH_SLACK


@wp.func
def splat_ellipse(mean: wp.vec2, conic: wp.vec3, opacity: float, depth: float, radius: wp.vec2i) -> Ellipse:
    e = Ellipse()
    e.reach = float(-1.0)
    if radius[0] <= 0 or radius[1] <= 0 or not opacity >= ALPHA_MIN:
        return e
    # The sum is non-finite if a product is, or if products are so large that the splat is useless anyway.
    if not wp.isfinite(mean[0] + mean[1] + conic[0] + conic[1] + conic[2] + opacity + depth):
        return e
    # In float64: of a needle's determinant float32 leaves nothing but rounding.
    determinant = float(wp.float64(conic[0]) * wp.float64(conic[2]) - wp.float64(conic[1]) * wp.float64(conic[1]))
    if determinant > 0.0 and conic[0] > 0.0:
        e.mean = mean
        e.reach = reach_of(opacity)
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
    """Return begin and end of the tiles along one axis whose intervals of pixel centres meet [low, high]."""
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
    # The row's span of pixel centres, limited to the ellipse's extent, may exclude either tip of the ellipse.
    low = wp.max(float(row * tile_size) + 0.5 - e.mean[1], -e.half_height)
    high = wp.min(float(wp.min((row + 1) * tile_size, height)) - 0.5 - e.mean[1], e.half_height)
    right = wp.clamp(e.tip, low, high)
    left = wp.clamp(-e.tip, low, high)
    # q = reach, solved for dx.
    x_right = e.shear * right + wp.sqrt(wp.max(e.spread - e.steepness * right * right, 0.0))
    x_left = e.shear * left - wp.sqrt(wp.max(e.spread - e.steepness * left * left, 0.0))
    return touched(e.mean[0] + x_left, e.mean[0] + x_right, tile_size, columns, width)


@wp.func
def rows_within(span: wp.vec2i, tile_begin: int, tile_end: int, columns: int) -> wp.vec2i:
    """Restrict a range of rows of tiles to the rows that contain tiles ``tile_begin`` to ``tile_end``."""
    return wp.vec2i(wp.max(span[0], tile_begin // columns), wp.min(span[1], (tile_end + columns - 1) // columns))


@wp.func
def columns_within(span: wp.vec2i, row: int, tile_begin: int, tile_end: int, columns: int) -> wp.vec2i:
    """Restrict a row's range of tiles to tiles ``tile_begin`` to ``tile_end``."""
    begin = wp.max(span[0], tile_begin - row * columns)
    return wp.vec2i(begin, wp.max(begin, wp.min(span[1], tile_end - row * columns)))
