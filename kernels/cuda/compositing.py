"""Alpha compositing on CUDA, in native code: one block of 256 threads per tile of 16 x 16, one thread per pixel.

The kernels compute what ``compositing`` computes; the work is laid out as follows:

- A warp holds 8 x 4 pixels, one of the tile's eight parts. Splats are staged through shared memory in batches. The
  thread that stages a splat determines which parts its ellipse may reach. A ballot collects these bits, so that each
  warp visits only splats that may reach its own part.
- Exponentials are taken to base 2: ``alpha = 2^(p - s ln 2 p^2 + log2 o)``, where the factor of ``p = -q / (2 ln 2)``
  is folded into the staged conic.
- The adjoint needs 12 sums over a warp for each pair, with more than four channels 16 (the columns of a slot). Every
  step halves the number of sums that a lane holds, so all of them take 13 or 16 shuffles together instead of 5 each.
  The partial sums of the eight warps are gathered in shared memory, 32 pairs at a time, and added in the order of the
  warps into the pair's own slot. Without atomics the results are reproducible bit by bit.

On a CPU the native functions are empty; tests compile them with a shim that runs a block's threads as fibres.
"""

from __future__ import annotations

import warp as wp

from ..native import native_function
from ..types import SLOT_GEOMETRY, TILE_SIZE
from .slots import SLOT_WIDTH

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

BLOCK_DIM = TILE_SIZE * TILE_SIZE
MAX_CHANNELS = SLOT_WIDTH - SLOT_GEOMETRY
"""Largest number of channels that fit into a slot; the forward pass has no such bound."""

_FORWARD_BOUNDS, _ADJOINT_BOUNDS = (BLOCK_DIM, 6), (BLOCK_DIM, 4)
"""Launch bounds: threads per block, and blocks per multiprocessor. They leave 40 and 64 registers to each thread, the
fewest that spill none to memory on sm_90 (``tests/kernels/test_compile.py``)."""


# fmt: off
@native_function("compositing_cuda.h", device="cuda")
def composite_tile(
    tile: int, means2d: wp.array[wp.vec2], conics: wp.array[wp.vec3], opacities: wp.array[float],
    channels: wp.array2d[float], background: wp.array[float], ranges: wp.array[wp.vec2i], splats: wp.array[int],
    width: int, height: int, columns: int, sharpness: float, image: wp.array3d[float], alpha_image: wp.array2d[float],
    transmittance_image: wp.array2d[float], last_image: wp.array2d[int],
): ...


@native_function("compositing_cuda.h", device="cuda")
def composite_tile_adjoint(
    tile: int, means2d: wp.array[wp.vec2], conics: wp.array[wp.vec3], opacities: wp.array[float],
    channels: wp.array2d[float], background: wp.array[float], ranges: wp.array[wp.vec2i], splats: wp.array[int],
    slots: wp.array[int], transmittance_image: wp.array2d[float], last_image: wp.array2d[int],
    v_image: wp.array3d[float], v_alpha: wp.array2d[float], width: int, height: int, columns: int, sharpness: float,
    v_slots: wp.array2d[float],
): ...
# fmt: on


@wp.kernel(launch_bounds=_FORWARD_BOUNDS)
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
    # Out:
    image_out: wp.array3d[float],  # [C, H, W] on the background
    alpha_out: wp.array2d[float],  # [H, W] 1 - final transmittance
    transmittance_out: wp.array2d[float],  # [H, W] final transmittance; empty: not wanted
    last_out: wp.array2d[int],  # [H, W] index in the sorted list of the last contributor, + 1; 0: none; empty too
):
    """Composite one tile per block, front to back. Grid: T x 256."""
    block, _lane = wp.tid()
    composite_tile(
        first + block, means2d_in, conics_in, opacities_in, channels_in, background_in, ranges_in, splats_in,
        width, height, columns, sharpness, image_out, alpha_out, transmittance_out, last_out,
    )  # fmt: skip


@wp.kernel(launch_bounds=_ADJOINT_BOUNDS)
def composite_adjoint(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    channels_in: wp.array2d[float],  # [N, C], C <= 8
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
    # Out:
    v_slots_out: wp.array2d[float],  # [P, 16] row: mean 2, conic 3, opacity 1, |mean| 2, channels C, zeros
):
    """Compute the gradients of one tile's pairs, back to front, into their slots. Grid: T x 256."""
    block, _lane = wp.tid()
    composite_tile_adjoint(
        first + block, means2d_in, conics_in, opacities_in, channels_in, background_in, ranges_in, splats_in, slots_in,
        transmittance_in, last_in, v_image_in, v_alpha_in, width, height, columns, sharpness, v_slots_out,
    )  # fmt: skip
