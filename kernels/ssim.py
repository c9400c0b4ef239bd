"""Photometric loss: L1, squared error and SSIM of two planar images, forward and adjoint.

SSIM is that of Wang et al. 2004 (equation 13), with an 11 x 11 Gaussian of sigma 1.5 and zero padding. The statistics
of a window follow from four blurred maps, ``x``, ``y``, ``x^2 + y^2`` and ``x y``, because the two variances occur only
as their sum. The forward pass stores the three partial derivatives of each SSIM value (with respect to blurred ``x``,
``x^2 + y^2`` and ``x y``). A blur is its own adjoint, so the gradient takes three more blurs::

    d/dx = G * d_mean + 2 x (G * d_squares) + y (G * d_product)

This form computes one pixel or one row per grid index and runs on any device; ``cpu/ssim.py`` is the SIMD form, and
``cuda/ssim.py`` the form for blocks of threads. Where ``mask`` is false, the image counts as equal to the truth, and
the pixel's own terms are left out.
"""

from __future__ import annotations

import math

import warp as wp

wp.set_module_options({"enable_backward": False})

RADIUS = 5
SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
LEAST_ERROR = 1e-7
"""Mean squared error below which its logarithm is constant: 70 dB."""

_taps = [math.exp(-0.5 * (i / SIGMA) ** 2) for i in range(RADIUS + 1)]
TAPS = [tap / (_taps[0] + 2.0 * sum(_taps[1:])) for tap in _taps]
"""Weights of one half of the window, centre first; the whole window sums to 1."""

Taps = wp.types.vector(length=RADIUS + 1, dtype=wp.float32)
_WINDOW = wp.constant(Taps(*TAPS))
_C1 = wp.constant(wp.float32(SSIM_C1))
_C2 = wp.constant(wp.float32(SSIM_C2))


@wp.kernel
def blur_rows(
    first: int,
    # In:
    image_in: wp.array3d[float],  # [C, H, W]
    truth_in: wp.array3d[float],  # [C, H, W]
    mask_in: wp.array2d[bool],  # [H, W], or null
    masked_in: int,  # 1: mask_in is there
    # Out:
    blurred_out: wp.array4d[float],  # [4, C, H, W] x, y, x^2 + y^2, x y, blurred along rows
):
    """Blur the four maps horizontally at a pixel. Grid: C x H x W."""
    i = first + wp.tid()
    height = image_in.shape[1]
    width = image_in.shape[2]
    column = i % width
    row = (i // width) % height
    channel = i // (width * height)
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for offset in range(-RADIUS, RADIUS + 1):
        at = column + offset
        if at >= 0 and at < width:
            y = truth_in[channel, row, at]
            x = y
            if masked_in == 0:
                x = image_in[channel, row, at]
            elif mask_in[row, at]:
                x = image_in[channel, row, at]
            total += _WINDOW[wp.abs(offset)] * wp.vec4(x, y, x * x + y * y, x * y)
    for j in range(4):
        blurred_out[j, channel, row, column] = total[j]


@wp.kernel
def photometric(
    first: int,
    # In:
    image_in: wp.array3d[float],  # [C, H, W]
    truth_in: wp.array3d[float],  # [C, H, W]
    mask_in: wp.array2d[bool],  # [H, W], or null
    masked_in: int,  # 1: mask_in is there
    blurred_in: wp.array4d[float],  # [4, C, H, W] of blur_rows
    # Out:
    values_out: wp.array4d[float],  # [3, C, H, W] |x - y|, SSIM and (x - y)^2, 0 where masked
    partials_out: wp.array4d[float],  # [3, C, H, W] of SSIM to blurred x, x^2 + y^2, x y
):
    """Compute a pixel's L1, squared error, SSIM and the partial derivatives of its SSIM. Grid: C x H x W."""
    i = first + wp.tid()
    height = image_in.shape[1]
    width = image_in.shape[2]
    column = i % width
    row = (i // width) % height
    channel = i // (width * height)
    valid = bool(True)
    if masked_in == 1:
        valid = mask_in[row, column]
    l1 = float(0.0)
    square = float(0.0)
    ssim = float(0.0)
    partials = wp.vec3(0.0, 0.0, 0.0)
    if valid:
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)
        for offset in range(-RADIUS, RADIUS + 1):
            at = row + offset
            if at >= 0 and at < height:
                tap = _WINDOW[wp.abs(offset)]
                for j in range(4):
                    total[j] = total[j] + tap * blurred_in[j, channel, at, column]
        cross = total[0] * total[1]
        squares = total[0] * total[0] + total[1] * total[1]
        a1 = 2.0 * cross + _C1
        a2 = 2.0 * (total[3] - cross) + _C2
        b1 = squares + _C1
        b2 = total[2] - squares + _C2
        inverse = 1.0 / (b1 * b2)
        ssim = a1 * a2 * inverse
        partials = wp.vec3(
            2.0 * inverse * (total[1] * (a2 - a1) + total[0] * ssim * (b1 - b2)),
            -ssim * inverse * b1,
            2.0 * a1 * inverse,
        )
        difference = image_in[channel, row, column] - truth_in[channel, row, column]
        l1 = wp.where(difference < 0.0, -difference, difference)
        square = difference * difference
    values_out[0, channel, row, column] = l1
    values_out[1, channel, row, column] = ssim
    values_out[2, channel, row, column] = square
    for j in range(3):
        partials_out[j, channel, row, column] = partials[j]


@wp.kernel
def sum_rows(
    first: int,
    # In:
    values_in: wp.array2d[float],  # [R, W]
    # Out:
    sums_out: wp.array[float],  # [R]
):
    """Sum each row from left to right. Grid: R."""
    i = first + wp.tid()
    total = float(0.0)
    for column in range(values_in.shape[1]):
        total += values_in[i, column]
    sums_out[i] = total


@wp.kernel
def blur_rows_adjoint(
    first: int,
    # In:
    partials_in: wp.array4d[float],  # [3, C, H, W]
    # Out:
    blurred_out: wp.array4d[float],  # [3, C, H, W] blurred along rows
):
    """Blur the three partial derivatives horizontally at a pixel. Grid: C x H x W."""
    i = first + wp.tid()
    height = partials_in.shape[2]
    width = partials_in.shape[3]
    column = i % width
    row = (i // width) % height
    channel = i // (width * height)
    total = wp.vec3(0.0, 0.0, 0.0)
    for offset in range(-RADIUS, RADIUS + 1):
        at = column + offset
        if at >= 0 and at < width:
            tap = _WINDOW[wp.abs(offset)]
            for j in range(3):
                total[j] = total[j] + tap * partials_in[j, channel, row, at]
    for j in range(3):
        blurred_out[j, channel, row, column] = total[j]


@wp.kernel
def photometric_adjoint(
    first: int,
    # In:
    image_in: wp.array3d[float],  # [C, H, W]
    truth_in: wp.array3d[float],  # [C, H, W]
    mask_in: wp.array2d[bool],  # [H, W], or null
    masked_in: int,  # 1: mask_in is there
    blurred_in: wp.array4d[float],  # [3, C, H, W] of blur_rows_adjoint
    v_sums_in: wp.array[float],  # [3] of the loss to the sums of L1, of SSIM and of squared errors
    # Out:
    v_image_out: wp.array3d[float],  # [C, H, W]
):
    """Compute the gradient of a pixel of the image. Grid: C x H x W."""
    i = first + wp.tid()
    height = image_in.shape[1]
    width = image_in.shape[2]
    column = i % width
    row = (i // width) % height
    channel = i // (width * height)
    valid = bool(True)
    if masked_in == 1:
        valid = mask_in[row, column]
    gradient = float(0.0)
    if valid:
        total = wp.vec3(0.0, 0.0, 0.0)
        for offset in range(-RADIUS, RADIUS + 1):
            at = row + offset
            if at >= 0 and at < height:
                tap = _WINDOW[wp.abs(offset)]
                for j in range(3):
                    total[j] = total[j] + tap * blurred_in[j, channel, at, column]
        x = image_in[channel, row, column]
        y = truth_in[channel, row, column]
        slope = wp.where(x > y, 1.0, wp.where(x < y, -1.0, 0.0))
        gradient = v_sums_in[0] * slope + v_sums_in[1] * (total[0] + 2.0 * x * total[1] + y * total[2])
        gradient += 2.0 * v_sums_in[2] * (x - y)
    v_image_out[channel, row, column] = gradient
