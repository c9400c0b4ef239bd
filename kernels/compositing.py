"""Alpha compositing on any device, one pixel per grid index (the adjoint: one tile).

Each pixel blends its tile's sorted splats front to back (3D Gaussian Splatting, Kerbl et al. 2023, equation 3)::

    image = sum_i channels_i alpha_i T_i + T_end background,    T_i = prod_{j < i} (1 - alpha_j)
    alpha_i = min(0.999, o_i exp(-u_i - s u_i^2)),    u = q / 2,    q = A dx^2 + 2 B dx dy + C dy^2,
    d = pixel centre - mean

The sharpness s is the same for all splats; with s = 0 they are Gaussians. A splat is skipped at a pixel where its alpha
is under 1/255, or where q < 0, which rounding can cause for needle-shaped splats. A pixel ends before the splat that
would bring its transmittance to 1e-4 or less. The faster forms in ``cpu/`` and ``cuda/`` are tested against this one.
"""

from __future__ import annotations

import warp as wp

from .falloff import falloff
from .gradient_limits import passed
from .types import ALPHA_MAX, ALPHA_MIN, CHANNEL_MAX, SLOT_GEOMETRY, STEP_FINE, TRANSMITTANCE_MIN

wp.set_module_options({"enable_backward": False})

SLOT_WIDTH = 16
"""Number of columns of a slot that fills one cache line and holds up to 8 channels."""


@wp.func
def squared_distance(conic: wp.vec3, d: wp.vec2) -> float:
    return conic[0] * d[0] * d[0] + 2.0 * conic[1] * d[0] * d[1] + conic[2] * d[1] * d[1]


@wp.kernel
def finite_opacities(
    first: int,
    # In:
    opacities_in: wp.array[float],  # [N]
    channels_in: wp.array2d[float],  # [N, C]
    # Out:
    opacities_out: wp.array[float],  # [N] zero where a channel is not usable, so that no form ever adds it
):
    i = first + wp.tid()
    finite = bool(True)
    for c in range(channels_in.shape[1]):
        finite = finite and wp.abs(channels_in[i, c]) <= CHANNEL_MAX
    opacity = float(0.0)
    if finite:
        opacity = opacities_in[i]
    opacities_out[i] = opacity


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
    pixel = first + wp.tid()
    y = pixel // width
    x = pixel - y * width
    centre = wp.vec2(float(x) + 0.5, float(y) + 0.5)
    span = ranges_in[(y // tile_size) * columns + x // tile_size]
    count = image_out.shape[0]
    for c in range(count):
        image_out[c, y, x] = 0.0
    transmittance = float(1.0)
    last = int(0)
    for p in range(span[0], span[1]):
        i = splats_in[p]
        q = squared_distance(conics_in[i], centre - means2d_in[i])
        alpha = wp.min(ALPHA_MAX, opacities_in[i] * falloff(q, sharpness))
        if not (q >= 0.0 and alpha >= ALPHA_MIN):
            continue
        remaining = transmittance * (1.0 - alpha)
        if remaining <= TRANSMITTANCE_MIN:
            break
        for c in range(count):
            image_out[c, y, x] = image_out[c, y, x] + channels_in[i, c] * alpha * transmittance
        transmittance = remaining
        last = p + 1
    for c in range(count):
        image_out[c, y, x] = image_out[c, y, x] + background_in[c] * transmittance
    alpha_out[y, x] = 1.0 - transmittance
    if last_out.shape[0] > 0:
        transmittance_out[y, x] = transmittance
        last_out[y, x] = last


@wp.func
def add_pixel_adjoint(
    centre: wp.vec2,
    mean: wp.vec2,
    conic: wp.vec3,
    opacity: float,
    sharpness: float,
    v_alpha: float,
    slot: int,
    v_slots: wp.array2d[float],
):
    """Add the gradients of a splat's mean, conic and opacity to its slot, from the gradient of its alpha at one
    pixel."""
    d = centre - mean
    q = squared_distance(conic, d)
    share = falloff(q, sharpness)
    if opacity * share > ALPHA_MAX:
        return
    g = v_alpha * opacity * share * (1.0 + sharpness * q)  # gradient to -q / 2
    v_mean = g * wp.vec2(conic[0] * d[0] + conic[1] * d[1], conic[1] * d[0] + conic[2] * d[1])
    v_slots[slot, 0] = v_slots[slot, 0] + v_mean[0]
    v_slots[slot, 1] = v_slots[slot, 1] + v_mean[1]
    v_slots[slot, 2] = v_slots[slot, 2] - 0.5 * g * d[0] * d[0]
    v_slots[slot, 3] = v_slots[slot, 3] - g * d[0] * d[1]
    v_slots[slot, 4] = v_slots[slot, 4] - 0.5 * g * d[1] * d[1]
    v_slots[slot, 5] = v_slots[slot, 5] + v_alpha * share
    v_slots[slot, 6] = v_slots[slot, 6] + wp.abs(v_mean[0])
    v_slots[slot, 7] = v_slots[slot, 7] + wp.abs(v_mean[1])


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
    """Compute the gradients of one tile's pairs, pixel by pixel, each back to front from its last contributor."""
    tile = first + wp.tid()
    span = ranges_in[tile]
    for p in range(span[0], span[1]):
        for k in range(v_slots_out.shape[1]):
            v_slots_out[slots_in[p], k] = 0.0
    y_begin = (tile // columns) * tile_size
    x_begin = (tile - (tile // columns) * columns) * tile_size
    for y in range(y_begin, wp.min(y_begin + tile_size, height)):
        for x in range(x_begin, wp.min(x_begin + tile_size, width)):
            centre = wp.vec2(float(x) + 0.5, float(y) + 0.5)
            transmittance = transmittance_in[y, x]
            behind = float(-v_alpha_in[y, x])  # colour behind the current splat, weighted by v_image
            for c in range(channels_in.shape[1]):
                behind += v_image_in[c, y, x] * background_in[c]
            behind *= transmittance
            p = int(last_in[y, x] - 1)
            while p >= span[0]:
                i = splats_in[p]
                slot = slots_in[p]
                q = squared_distance(conics_in[i], centre - means2d_in[i])
                alpha = wp.min(ALPHA_MAX, opacities_in[i] * falloff(q, sharpness))
                p -= 1
                if not (q >= 0.0 and alpha >= ALPHA_MIN):
                    continue
                transmittance /= 1.0 - alpha
                own = float(0.0)
                for c in range(channels_in.shape[1]):
                    own += channels_in[i, c] * v_image_in[c, y, x]
                    v_slots_out[slot, SLOT_GEOMETRY + c] = (
                        v_slots_out[slot, SLOT_GEOMETRY + c] + v_image_in[c, y, x] * alpha * transmittance
                    )
                v_alpha = own * transmittance - behind / (1.0 - alpha)
                behind += own * alpha * transmittance
                add_pixel_adjoint(
                    centre, means2d_in[i], conics_in[i], opacities_in[i], sharpness, v_alpha, slot, v_slots_out
                )


@wp.kernel
def sum_slots(
    first: int,
    # In:
    offsets_in: wp.array[wp.int64],  # [N + 1] a splat's slots
    v_slots_in: wp.array2d[float],  # [P, S]
    more: int,  # whether these sums go on from what the outputs hold, else from zero
    # Out:
    v_means2d_out: wp.array[wp.vec2],  # [N]
    v_conics_out: wp.array[wp.vec3],  # [N]
    v_opacities_out: wp.array[float],  # [N]
    v_channels_out: wp.array2d[float],  # [N, C]
    absgrad_out: wp.array[wp.vec2],  # [N]; empty: not wanted
):
    """Sum the gradient slots of each splat (one per tile that it touches) in the order in which binning emitted them.

    The fixed order makes results reproducible bit by bit.
    """
    i = first + wp.tid()
    begin = int(offsets_in[i])
    end = int(offsets_in[i + 1])
    v_mean = wp.vec2(0.0)
    v_conic = wp.vec3(0.0)
    v_opacity = float(0.0)
    absolute = wp.vec2(0.0)
    for c in range(v_channels_out.shape[1]):
        if more == 0:
            v_channels_out[i, c] = 0.0
    if more != 0:
        v_mean = v_means2d_out[i]
        v_conic = v_conics_out[i]
        v_opacity = v_opacities_out[i]
        if absgrad_out.shape[0] > 0:
            absolute = absgrad_out[i]
    for s in range(begin, end):
        v_mean += wp.vec2(v_slots_in[s, 0], v_slots_in[s, 1])
        v_conic += wp.vec3(v_slots_in[s, 2], v_slots_in[s, 3], v_slots_in[s, 4])
        v_opacity += v_slots_in[s, 5]
        absolute += wp.vec2(v_slots_in[s, 6], v_slots_in[s, 7])
        for c in range(v_channels_out.shape[1]):
            v_channels_out[i, c] = v_channels_out[i, c] + v_slots_in[s, SLOT_GEOMETRY + c]
    v_means2d_out[i] = passed(v_mean)
    v_conics_out[i] = passed(v_conic)
    v_opacities_out[i] = passed(v_opacity)
    if absgrad_out.shape[0] > 0:
        absgrad_out[i] = passed(absolute)


@wp.kernel
def add_stats(
    first: int,
    # In:
    v_means2d_in: wp.array[wp.vec2],  # [N] summed (or summed absolute) gradients to the 2D means
    radii_in: wp.array[wp.vec2i],  # [N] pixels; a zero: culled
    width: int,
    height: int,
    outcome_in: wp.array[int],  # [1] of a recorded step: nothing is added unless it is STEP_FINE
    has_outcome: int,
    # Out (added to):
    grad_norm_out: wp.array[float],  # [N]
    count_out: wp.array[float],  # [N]
    max_radii_out: wp.array[float],  # [N]
):
    if has_outcome != 0:
        if outcome_in[0] != STEP_FINE:
            return
    i = first + wp.tid()
    radius = wp.max(radii_in[i][0], radii_in[i][1])
    if radius <= 0:
        return
    v = v_means2d_in[i]
    ndc = wp.vec2(v[0] * 0.5 * float(width), v[1] * 0.5 * float(height))
    norm = wp.length(ndc)
    if wp.isfinite(norm):  # an infinite norm means that its square overflowed
        grad_norm_out[i] = grad_norm_out[i] + norm
    count_out[i] = count_out[i] + 1.0
    max_radii_out[i] = wp.max(max_radii_out[i], float(radius) / float(wp.max(width, height)))


@wp.kernel
def background_rows(
    first: int,
    # In:
    v_image_in: wp.array3d[float],  # [C, H, W]
    transmittance_in: wp.array2d[float],  # [H, W]
    # Out:
    rows_out: wp.array2d[float],  # [H, C] gradient to the background, image row by image row
):
    y = first + wp.tid()
    for c in range(v_image_in.shape[0]):
        total = float(0.0)
        for x in range(v_image_in.shape[2]):
            total += v_image_in[c, y, x] * transmittance_in[y, x]
        rows_out[y, c] = total


@wp.kernel
def sum_rows(
    first: int,
    # In:
    rows_in: wp.array2d[float],  # [H, C]
    # Out:
    total_out: wp.array[float],  # [C]
):
    c = first + wp.tid()
    total = float(0.0)
    for y in range(rows_in.shape[0]):
        total += rows_in[y, c]
    total_out[c] = total


@wp.kernel
def expected_depth(
    first: int,
    # In:
    accumulated_in: wp.array[float],  # [H W] depth times alpha
    alpha_in: wp.array[float],  # [H W]
    unit: wp.float64,
    # Out:
    depth_out: wp.array[float],  # [H W]
):
    """Divide the accumulated depth by alpha, then by the unit in double precision. Grid: H W."""
    p = first + wp.tid()
    depth = accumulated_in[p] / wp.max(alpha_in[p], 1e-10)
    depth_out[p] = float(wp.float64(depth) / unit)
