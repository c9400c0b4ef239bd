"""Alpha compositing by blocks of threads through Warp's tile API: one block per tile, one thread per pixel.

These kernels blend any number of channels; meaning and arguments are those of ``compositing``, with a ``tile_size`` of
16. The block fetches a tile's splats into shared memory in batches of 256, one per thread, and every thread walks the
batch for its own pixel. Nothing here is specific to CUDA: with ``wp.config.enable_cpu_blocks`` the same kernels run
(slowly) on a CPU, where they are tested.

All threads of a block must reach ``tile_max``, ``tile_sum``, ``tile_scatter_masked`` and reads of their results
together, so loops around them have bounds that all threads share. Reads of a shared tile are exempt. ``tile_max`` at
the head of a batch is also the barrier that keeps the next batch from overwriting the current one early.
"""

from __future__ import annotations

import warp as wp

from ..compositing import squared_distance
from ..falloff import falloff
from ..types import ALPHA_MAX, ALPHA_MIN, SLOT_GEOMETRY, TILE_SIZE, TRANSMITTANCE_MIN

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

BLOCK_DIM = TILE_SIZE * TILE_SIZE
_LANES = wp.constant(BLOCK_DIM)
GROUP = wp.constant(4)
"""Number of channels composited in one pass over the splats (colour and depth). Further channels take more passes."""
_SUMS = wp.constant(SLOT_GEOMETRY + 4)

Splat = wp.types.vector(length=6, dtype=wp.float32)
"""Geometry of a splat in shared memory: mean (2), conic (3), opacity (1)."""
Sums = wp.types.vector(length=SLOT_GEOMETRY + 4, dtype=wp.float32)
"""Values of the leading columns of a gradient slot."""


@wp.func
def pack(mean: wp.vec2, conic: wp.vec3, opacity: float) -> Splat:
    return Splat(mean[0], mean[1], conic[0], conic[1], conic[2], opacity)


@wp.func
def squared_distance_of(splat: Splat, d: wp.vec2) -> float:
    return squared_distance(wp.vec3(splat[2], splat[3], splat[4]), d)


@wp.func
def group_of(channels: wp.array2d[float], i: int, base: int) -> wp.vec4:
    """Return four channels of a splat, zero beyond the last."""
    values = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for c in range(4):
        if base + c < channels.shape[1]:
            values[c] = channels[i, base + c]
    return values


@wp.func
def pixel_group(image: wp.array3d[float], y: int, x: int, base: int) -> wp.vec4:
    """Return four channels of a pixel, zero beyond the last."""
    values = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for c in range(4):
        if base + c < image.shape[0]:
            values[c] = image[base + c, y, x]
    return values


@wp.kernel
def composite(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N] pixels
    conics_in: wp.array[wp.vec3],  # [N] (A, B, C), 1 / px^2
    opacities_in: wp.array[float],  # [N]
    channels_in: wp.array2d[float],  # [N, C]
    background_in: wp.array[float],  # [C]
    ranges_in: wp.array[wp.vec2i],  # [T] begin and end of each tile in the sorted list
    splats_in: wp.array[int],  # [P] the sorted list
    width: int,
    height: int,
    columns: int,
    sharpness: float,
    tile_size: int,
    # Out:
    image_out: wp.array3d[float],  # [C, H, W] on the background
    alpha_out: wp.array2d[float],  # [H, W] 1 - final transmittance
    transmittance_out: wp.array2d[float],  # [H, W] final transmittance; empty: not wanted
    last_out: wp.array2d[int],  # [H, W] index in the sorted list of the last contributor, + 1; 0: none; empty too
):
    """Composite one tile front to back, four channels at a time. Grid: T x 256."""
    block, lane = wp.tid()
    tile = first + block
    x = (tile % columns) * tile_size + lane % tile_size
    y = (tile // columns) * tile_size + lane // tile_size
    inside = x < width and y < height
    centre = wp.vec2(float(x) + 0.5, float(y) + 0.5)
    span = ranges_in[tile]
    staged = wp.tile_zeros(shape=_LANES, dtype=Splat, storage="shared")
    colors = wp.tile_zeros(shape=_LANES, dtype=wp.vec4, storage="shared")
    count = image_out.shape[0]
    for base in range(0, count, GROUP):
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)
        transmittance = float(1.0)
        last = int(0)
        open = int(1)
        if not inside:
            open = int(0)
        begin = int(span[0])
        while begin < span[1]:
            some_open = wp.tile_max(wp.tile(open))
            if some_open[0] == 0:
                break
            mine = begin + lane
            splat = Splat()
            color = wp.vec4(0.0, 0.0, 0.0, 0.0)
            if mine < span[1]:
                i = splats_in[mine]
                splat = pack(means2d_in[i], conics_in[i], opacities_in[i])
                color = group_of(channels_in, i, base)
            wp.tile_scatter_masked(staged, lane, splat, True)
            wp.tile_scatter_masked(colors, lane, color, True)
            j = int(0)
            size = wp.min(_LANES, span[1] - begin)
            while open == 1 and j < size:
                own = wp.tile_extract(staged, j)
                q = squared_distance_of(own, centre - wp.vec2(own[0], own[1]))
                alpha = wp.min(ALPHA_MAX, own[5] * falloff(q, sharpness))
                if q >= 0.0 and alpha >= ALPHA_MIN:
                    remaining = transmittance * (1.0 - alpha)
                    if remaining <= TRANSMITTANCE_MIN:
                        open = int(0)
                    else:
                        total += wp.tile_extract(colors, j) * (alpha * transmittance)
                        transmittance = remaining
                        last = begin + j + 1
                j += 1
            begin += _LANES
        if inside:
            for c in range(4):
                if base + c < count:
                    image_out[base + c, y, x] = total[c] + background_in[base + c] * transmittance
            alpha_out[y, x] = 1.0 - transmittance
            if last_out.shape[0] > 0:
                transmittance_out[y, x] = transmittance
                last_out[y, x] = last


@wp.func
def geometry_sums(own: Splat, d: wp.vec2, share: float, slope: float, v_alpha: float) -> Sums:
    """Return the gradients of a splat's mean, conic and opacity from that of its alpha at a pixel; 0 where clamped.

    Alpha is the opacity times ``share``, whose logarithm changes by ``slope`` with -q / 2.
    """
    sums = Sums()
    if own[5] * share <= ALPHA_MAX:
        g = v_alpha * own[5] * share * slope  # gradient to -q / 2
        sums[0] = g * (own[2] * d[0] + own[3] * d[1])
        sums[1] = g * (own[3] * d[0] + own[4] * d[1])
        sums[2] = -0.5 * g * d[0] * d[0]
        sums[3] = -g * d[0] * d[1]
        sums[4] = -0.5 * g * d[1] * d[1]
        sums[5] = v_alpha * share
        sums[6] = wp.abs(sums[0])
        sums[7] = wp.abs(sums[1])
    return sums


@wp.kernel
def composite_adjoint(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    channels_in: wp.array2d[float],  # [N, C]
    background_in: wp.array[float],  # [C]
    ranges_in: wp.array[wp.vec2i],  # [T]
    splats_in: wp.array[int],  # [P]
    slots_in: wp.array[int],  # [P] row of v_slots_out of each pair
    transmittance_in: wp.array2d[float],  # [H, W] what the forward pass stored
    last_in: wp.array2d[int],  # [H, W]
    v_image_in: wp.array3d[float],  # [C, H, W]
    v_alpha_in: wp.array2d[float],  # [H, W]
    width: int,
    height: int,
    columns: int,
    sharpness: float,
    tile_size: int,
    absolute: int,  # whether columns 6 and 7 are wanted (they are written all the same)
    # Out:
    v_slots_out: wp.array2d[float],  # [P, S], S >= 8 + C; row: mean 2, conic 3, opacity 1, |mean| 2, channels C, rest
):
    """Walk one tile back to front from its last contributor, summing each pair's gradients over the block.

    Grid: T x 256.
    """
    block, lane = wp.tid()
    tile = first + block
    x = (tile % columns) * tile_size + lane % tile_size
    y = (tile // columns) * tile_size + lane // tile_size
    centre = wp.vec2(float(x) + 0.5, float(y) + 0.5)
    span = ranges_in[tile]
    count = channels_in.shape[1]
    transmittance = float(1.0)
    last = int(0)
    behind = float(0.0)  # colour behind the current splat, weighted by v_image
    v_pixel = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if x < width and y < height:
        last = last_in[y, x]
        transmittance = transmittance_in[y, x]
        behind = -v_alpha_in[y, x]
        for c in range(count):
            behind += v_image_in[c, y, x] * background_in[c]
        behind *= transmittance
        v_pixel = pixel_group(v_image_in, y, x, 0)
    deepest = wp.tile_max(wp.tile(last))
    end = int(wp.max(deepest[0], span[0]))
    for p in range(end + lane, span[1], _LANES):  # pairs that no pixel used
        for k in range(v_slots_out.shape[1]):
            v_slots_out[slots_in[p], k] = 0.0
    staged = wp.tile_zeros(shape=_LANES, dtype=Splat, storage="shared")
    colors = wp.tile_zeros(shape=_LANES, dtype=wp.vec4, storage="shared")
    while end > span[0]:
        begin = wp.max(span[0], end - _LANES)
        mine = begin + lane
        splat = Splat()
        color = wp.vec4(0.0, 0.0, 0.0, 0.0)
        if mine < end:
            i = splats_in[mine]
            splat = pack(means2d_in[i], conics_in[i], opacities_in[i])
            color = group_of(channels_in, i, 0)
        wp.tile_scatter_masked(staged, lane, splat, True)
        wp.tile_scatter_masked(colors, lane, color, True)
        for back in range(end - begin):
            p = end - 1 - back
            own = wp.tile_extract(staged, p - begin)
            d = centre - wp.vec2(own[0], own[1])
            q = squared_distance_of(own, d)
            share = falloff(q, sharpness)
            alpha = wp.min(ALPHA_MAX, own[5] * share)
            weight = float(0.0)
            sums = Sums()
            if p < last and q >= 0.0 and alpha >= ALPHA_MIN:
                transmittance /= 1.0 - alpha
                weight = alpha * transmittance
                seen = wp.dot(wp.tile_extract(colors, p - begin), v_pixel)
                for c in range(GROUP, count):
                    seen += channels_in[splats_in[p], c] * v_image_in[c, y, x]
                v_alpha = seen * transmittance - behind / (1.0 - alpha)
                behind += seen * weight
                sums = geometry_sums(own, d, share, 1.0 + sharpness * q, v_alpha)
                for c in range(4):
                    sums[SLOT_GEOMETRY + c] = weight * v_pixel[c]
            totals = wp.tile_sum(wp.tile(sums, preserve_type=True))
            column = wp.tile_extract(totals, 0, wp.min(lane, _SUMS - 1))
            slot = slots_in[p]
            if lane < wp.min(_SUMS, v_slots_out.shape[1]):
                v_slots_out[slot, lane] = column
            for k in range(_SUMS + lane, v_slots_out.shape[1], _LANES):
                v_slots_out[slot, k] = 0.0
            for base in range(GROUP, count, GROUP):
                v_more = wp.vec4(0.0, 0.0, 0.0, 0.0)
                if weight > 0.0:
                    v_more = weight * pixel_group(v_image_in, y, x, base)
                more = wp.tile_sum(wp.tile(v_more, preserve_type=True))
                extra = wp.tile_extract(more, 0, wp.min(lane, 3))
                # tile_sum's barriers come after the zeros above
                if lane < 4 and base + lane < count:
                    v_slots_out[slot, SLOT_GEOMETRY + base + lane] = extra
        end = begin
