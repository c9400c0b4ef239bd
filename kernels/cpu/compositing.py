"""Alpha compositing on a CPU: one tile per grid index, a block of 4 x 4 pixels in one SIMD register.

The kernels compute what ``compositing`` computes; the work is laid out as follows:

- Splats are packed beforehand (``pack_splats``): a pair reads one or two cache lines, and the logarithm and the
  divisions are done once per splat.
- Exponentials are taken to base 2: ``alpha = 2^(log2 o - f - s ln 2 f^2)``, where the factor of the fall
  ``f = q / (2 ln 2)`` is folded into the conic.
- Which of a tile's 16 blocks a splat reaches is computed for all of them at once, one per lane; only those are visited.
  A splat of a few pixels reaches fewer blocks than it would reach rows of 16 pixels.
- A pixel that has ended gets a negative transmittance, so the test of the next transmittance, > 1e-4, always fails.
- The adjoint first contracts a splat's channels with the incoming gradient, so one running sum per pixel suffices. The
  sums of a (tile, splat) pair stay in registers, one pixel of a block per lane; at the end the lanes are added up, for
  16 sums at a time.
"""

from __future__ import annotations

import warp as wp

from ..native import native_function
from ..types import LANES

wp.set_module_options({"enable_backward": False})

_LANES = wp.constant(LANES)


# fmt: off
@native_function("packing.h")
def pack_block(
    begin: int, means2d: wp.array[wp.vec2], conics: wp.array[wp.vec3], opacities: wp.array[float],
    channels: wp.array2d[float], sharpness: float, packed: wp.array2d[float],
): ...


@native_function("compositing.h")
def composite_tile(
    tile: int, packed: wp.array2d[float], background: wp.array[float], ranges: wp.array[wp.vec2i],
    splats: wp.array[int], width: int, height: int, columns: int, sharpness: float, depth_unit: wp.float64,
    image: wp.array3d[float], alpha_image: wp.array2d[float], transmittance: wp.array2d[float], last: wp.array2d[int],
): ...


@native_function("compositing.h")
def composite_tile_adjoint(
    tile: int, packed: wp.array2d[float], background: wp.array[float], ranges: wp.array[wp.vec2i],
    splats: wp.array[int], slots: wp.array[int], transmittance: wp.array2d[float], last: wp.array2d[int],
    v_image: wp.array3d[float], v_alpha: wp.array2d[float], width: int, height: int, columns: int, sharpness: float,
    absolute: int, v_slots: wp.array2d[float],
): ...


@native_function("slots.h")
def sum_slots_block(
    begin: int, offsets: wp.array[wp.int64], v_slots: wp.array2d[float], more: int,
    v_means2d: wp.array[wp.vec2], v_conics: wp.array[wp.vec3], v_opacities: wp.array[float],
    v_channels: wp.array2d[float], absgrad: wp.array[wp.vec2],
): ...


# fmt: on


@wp.kernel
def pack_splats(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    channels_in: wp.array2d[float],  # [N, C]
    sharpness: float,
    # Out:
    packed_out: wp.array2d[float],  # [N, 16], or [N, 10 + C or more] with more than 4 channels
):
    """Pack 16 splats. Grid: ceil(N / 16)."""
    begin = (first + wp.tid()) * _LANES
    pack_block(begin, means2d_in, conics_in, opacities_in, channels_in, sharpness, packed_out)


@wp.kernel
def composite(
    first: int,
    # In:
    packed_in: wp.array2d[float],  # [N, 16], or [N, 10 + C or more]
    background_in: wp.array[float],  # [C]
    ranges_in: wp.array[wp.vec2i],  # [T]
    splats_in: wp.array[int],  # [P]
    width: int,
    height: int,
    columns: int,
    sharpness: float,
    depth_unit: wp.float64,  # above 0: the last channel is depth, which is divided by alpha and by this unit
    # Out:
    image_out: wp.array3d[float],  # [C, H, W]
    alpha_out: wp.array2d[float],  # [H, W]
    transmittance_out: wp.array2d[float],  # [H, W]; empty: not wanted
    last_out: wp.array2d[int],  # [H, W]; empty too
):
    composite_tile(
        first + wp.tid(),
        packed_in,
        background_in,
        ranges_in,
        splats_in,
        width,
        height,
        columns,
        sharpness,
        depth_unit,
        image_out,
        alpha_out,
        transmittance_out,
        last_out,
    )


@wp.kernel
def composite_adjoint(
    first: int,
    # In:
    packed_in: wp.array2d[float],  # [N, 16], or [N, 10 + C or more]
    background_in: wp.array[float],  # [C]
    ranges_in: wp.array[wp.vec2i],  # [T]
    splats_in: wp.array[int],  # [P]
    slots_in: wp.array[int],  # [P]
    transmittance_in: wp.array2d[float],  # [H, W]
    last_in: wp.array2d[int],  # [H, W]
    v_image_in: wp.array3d[float],  # [C, H, W]
    v_alpha_in: wp.array2d[float],  # [H, W], or null: zeros
    width: int,
    height: int,
    columns: int,
    sharpness: float,
    absolute: int,  # whether the absolute sums are wanted; else zero
    # Out:
    v_slots_out: wp.array2d[float],  # [P, S], S >= 16 and S >= 8 + C
):
    composite_tile_adjoint(
        first + wp.tid(),
        packed_in,
        background_in,
        ranges_in,
        splats_in,
        slots_in,
        transmittance_in,
        last_in,
        v_image_in,
        v_alpha_in,
        width,
        height,
        columns,
        sharpness,
        absolute,
        v_slots_out,
    )


@wp.kernel
def sum_slots(
    first: int,
    # In:
    offsets_in: wp.array[wp.int64],  # [N + 1] a splat's slots
    v_slots_in: wp.array2d[float],  # [P, 16]
    more: int,  # whether these sums go on from what the outputs hold, else from zero
    # Out:
    v_means2d_out: wp.array[wp.vec2],  # [N]
    v_conics_out: wp.array[wp.vec3],  # [N]
    v_opacities_out: wp.array[float],  # [N]
    v_channels_out: wp.array2d[float],  # [N, C], C <= 8
    absgrad_out: wp.array[wp.vec2],  # [N]; empty: not wanted
):
    """Sum the slots of 16 splats, to the bits of the portable form. Grid: ceil(N / 16)."""
    begin = (first + wp.tid()) * _LANES
    sum_slots_block(
        begin,
        offsets_in,
        v_slots_in,
        more,
        v_means2d_out,
        v_conics_out,
        v_opacities_out,
        v_channels_out,
        absgrad_out,
    )
