"""Measurements for benchmarks: arithmetic without memory access, and the number of splats blended per pixel."""

from __future__ import annotations

import warp as wp

from .compositing import squared_distance
from .falloff import falloff
from .types import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

wp.set_module_options({"enable_backward": False})


@wp.kernel
def arithmetic(
    first: int,
    # In:
    rounds: int,
    # Out:
    values_out: wp.array[float],  # [C] written, so that no compiler drops the loop
):
    """Iterate the logistic map in C independent chains. Grid: C."""
    i = first + wp.tid()
    x = float(0.3)
    # The compiler cannot shorten the loop, because the chaotic map has no closed form. The value stays in a register.
    for _round in range(rounds):
        x = 3.9 * x * (1.0 - x)
    values_out[i] = x


@wp.kernel
def count_contributors(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N] pixels
    conics_in: wp.array[wp.vec3],  # [N] (A, B, C), 1 / px^2
    opacities_in: wp.array[float],  # [N]
    ranges_in: wp.array[wp.vec2i],  # [T] begin and end of each tile in the sorted list
    splats_in: wp.array[int],  # [P] the sorted list
    width: int,
    columns: int,
    sharpness: float,
    tile_size: int,
    # Out:
    counts_out: wp.array[int],  # [H * W] splats blended before the pixel ended
):
    """Count the splats that contribute to a pixel. Grid: H x W."""
    pixel = first + wp.tid()
    y = pixel // width
    x = pixel - y * width
    centre = wp.vec2(float(x) + 0.5, float(y) + 0.5)
    span = ranges_in[(y // tile_size) * columns + x // tile_size]
    transmittance = float(1.0)
    count = int(0)
    for p in range(span[0], span[1]):
        i = splats_in[p]
        q = squared_distance(conics_in[i], centre - means2d_in[i])
        alpha = wp.min(ALPHA_MAX, opacities_in[i] * falloff(q, sharpness))
        if not (q >= 0.0 and alpha >= ALPHA_MIN):
            continue
        transmittance *= 1.0 - alpha
        if transmittance <= TRANSMITTANCE_MIN:
            break
        count += 1
    counts_out[pixel] = count
