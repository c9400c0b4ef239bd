"""Photometric loss in SIMD: one grid index processes a band of rows of one channel. ``ssim`` defines the loss.

A band is processed from top to bottom. Each row is blurred horizontally into a ring of 11 rows, which stays in the
first-level cache. As soon as the ring is full, its middle row is blurred vertically and finished. A vector holds 16
neighbouring pixels.
"""

from __future__ import annotations

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False})


# fmt: off
@native_function("ssim.h")
def photometric_band(
    index: int, image: wp.array3d[float], truth: wp.array3d[float], mask: wp.array2d[bool], sums: wp.array3d[float],
    partials: wp.array4d[float],
): ...


@native_function("ssim.h")
def photometric_band_adjoint(
    index: int, image: wp.array3d[float], truth: wp.array3d[float], mask: wp.array2d[bool],
    partials: wp.array4d[float], v_sums: wp.array[float], v_image: wp.array3d[float],
): ...
# fmt: on


@wp.kernel
def photometric(
    first: int,
    # In:
    image_in: wp.array3d[float],  # [C, H, W]
    truth_in: wp.array3d[float],  # [C, H, W]
    mask_in: wp.array2d[bool],  # [H, W], or null: every pixel is valid
    # Out:
    sums_out: wp.array3d[float],  # [3, C, H] of |x - y|, of SSIM and of (x - y)^2 along rows
    partials_out: wp.array4d[float],  # [3, C, H, W] of SSIM to blurred x, x^2 + y^2, x y; or null
):
    """Compute row sums and partial derivatives of a band. Grid: C x ceil(H / SSIM_BAND)."""
    photometric_band(first + wp.tid(), image_in, truth_in, mask_in, sums_out, partials_out)


@wp.kernel
def photometric_adjoint(
    first: int,
    # In:
    image_in: wp.array3d[float],  # [C, H, W]
    truth_in: wp.array3d[float],  # [C, H, W]
    mask_in: wp.array2d[bool],  # [H, W], or null: every pixel is valid
    partials_in: wp.array4d[float],  # [3, C, H, W]
    v_sums_in: wp.array[float],  # [3] of the loss to the sums of L1, of SSIM and of squared errors
    # Out:
    v_image_out: wp.array3d[float],  # [C, H, W]
):
    """Compute the gradient of a band of the image. Grid: C x ceil(H / SSIM_BAND)."""
    index = first + wp.tid()
    photometric_band_adjoint(index, image_in, truth_in, mask_in, partials_in, v_sums_in, v_image_out)
