"""Photometric loss on CUDA, in native code: a block of 256 threads per tile of 32 x 16 pixels of one channel.

``ssim`` defines the loss. A block holds the pixels of its tile and of the five rows and columns around it in shared
memory, and blurs there: along rows with four columns per thread, and down columns with two rows per thread. A value
that is read thus serves several sums, because reads of shared memory limit the speed. Blurred maps are never written to
global memory; the adjoint reads three partial derivatives per pixel.

The sums over a tile take one tree over the lanes of each warp and one over the warps, and ``photometric_total`` adds
the sums of all tiles in double precision, so results are reproducible bit by bit. It also computes the loss and the
factors that the adjoint needs, which would be a dozen operations of torch.

On a CPU the native functions are empty; tests compile them with a shim that runs a block's threads as fibres.
"""

from __future__ import annotations

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False})

BLOCK_DIM = 256
_BOUNDS = (BLOCK_DIM, 5)
"""Launch bounds: threads per block, and blocks per multiprocessor. They leave 48 registers to each thread, which spills
nothing; without them ``photometric`` takes 64, and four blocks fit."""


# fmt: off
@native_function("ssim_cuda.h", device="cuda")
def photometric_tile(
    block: int, image: wp.array3d[float], truth: wp.array3d[float], mask: wp.array2d[bool], sums: wp.array2d[float],
    partials: wp.array4d[float],
): ...


@native_function("ssim_cuda.h", device="cuda")
def sum_photometric(
    block: int, sums: wp.array2d[float], ssim_weight: wp.float64, log_weight: wp.float64, results: wp.array[float],
    slopes: wp.array[float],
): ...


@native_function("ssim_cuda.h", device="cuda")
def photometric_tile_adjoint(
    block: int, image: wp.array3d[float], truth: wp.array3d[float], mask: wp.array2d[bool],
    partials: wp.array4d[float], slopes: wp.array[float], v_loss: wp.array[float], v_l1: wp.array[float],
    v_ssim: wp.array[float], ssim_weight: float, v_image: wp.array3d[float],
): ...
# fmt: on


@wp.kernel(launch_bounds=_BOUNDS)
def photometric(
    first: int,
    # In:
    image_in: wp.array3d[float],  # [C, H, W]
    truth_in: wp.array3d[float],  # [C, H, W]
    mask_in: wp.array2d[bool],  # [H, W], or null: every pixel is valid
    # Out:
    sums_out: wp.array2d[float],  # [B, 4] of a tile's valid pixels: |x - y|, SSIM, (x - y)^2, their number
    partials_out: wp.array4d[float],  # [3, C, H, W] of SSIM to blurred x, x^2 + y^2, x y; or null
):
    """Compute sums and partial derivatives of one tile of a channel per block. Grid: B x 256, B tiles in all."""
    block, _lane = wp.tid()
    photometric_tile(first + block, image_in, truth_in, mask_in, sums_out, partials_out)


@wp.kernel
def photometric_total(
    first: int,
    # In:
    sums_in: wp.array2d[float],  # [B, 4] of photometric
    ssim_weight: wp.float64,
    log_weight: wp.float64,
    # Out:
    results_out: wp.array[float],  # [3] loss, mean of |x - y|, mean SSIM
    slopes_out: wp.array[float],  # [2] of a mean to its sum; of the loss to the sum of squares
):
    """Add up the sums of all tiles and compute the loss. Grid: 1 x 256."""
    block, _lane = wp.tid()
    sum_photometric(first + block, sums_in, ssim_weight, log_weight, results_out, slopes_out)


@wp.kernel
def photometric_adjoint(
    first: int,
    # In:
    image_in: wp.array3d[float],  # [C, H, W]
    truth_in: wp.array3d[float],  # [C, H, W]
    mask_in: wp.array2d[bool],  # [H, W], or null: every pixel is valid
    partials_in: wp.array4d[float],  # [3, C, H, W] of photometric
    slopes_in: wp.array[float],  # [2] of photometric_total
    v_loss_in: wp.array[float],  # [1], or null: 0
    v_l1_in: wp.array[float],  # [1], or null: 0
    v_ssim_in: wp.array[float],  # [1], or null: 0
    ssim_weight: float,
    # Out:
    v_image_out: wp.array3d[float],  # [C, H, W]
):
    """Compute the gradient of one tile of a channel per block. Grid: B x 256."""
    block, _lane = wp.tid()
    photometric_tile_adjoint(
        first + block, image_in, truth_in, mask_in, partials_in, slopes_in, v_loss_in, v_l1_in, v_ssim_in, ssim_weight,
        v_image_out,
    )  # fmt: skip
