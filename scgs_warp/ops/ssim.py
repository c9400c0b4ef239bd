"""Photometric loss as one autograd op: L1, SSIM and squared error share their passes over the images, and one
adjoint."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..kernels import ssim as kernels
from ..kernels.cpu import ssim as cpu_kernels
from ..kernels.ssim import LEAST_ERROR
from ..kernels.types import SSIM_BAND
from ..runtime.launch import launch
from . import forms
from .forms import GpuForm
from .ssim_cuda import PhotometricTiles


def ssim(image: Tensor, truth: Tensor, mask: Tensor | None = None, *, form: GpuForm = "auto") -> Tensor:
    """Return the structural similarity (Wang et al. 2004): 11 x 11 Gaussian, sigma 1.5, zero padding, data range 1.

    Args:
        image: [C, H, W] float32.
        truth: [C, H, W] float32, a constant: no gradient reaches it.
        mask: [H, W] bool, True for valid pixels. None: all are valid. Invalid pixels of ``image`` are replaced by those
            of ``truth`` so that they do not affect neighbouring windows, and they are left out of the mean.
        form: kernels to run: ``plain`` on any device, ``cpu`` in SIMD, ``cuda`` on a GPU; ``auto`` takes the fastest
            for the device.

    Returns:
        The mean over valid pixels and channels, a scalar; 1 if no pixel is valid. Differentiable in ``image``.

    Raises:
        ValueError: a shape, dtype or device is wrong; the message names the argument.
    """
    return photometric_loss(image, truth, mask, 0.0, form=form)[2]


def photometric_loss(
    image: Tensor,
    truth: Tensor,
    mask: Tensor | None = None,
    ssim_weight: float = 0.2,
    log_weight: float = 0.0,
    *,
    form: GpuForm = "auto",
) -> tuple[Tensor, Tensor, Tensor]:
    """Return ``(1 - w) L1 + w (1 - SSIM)`` (Kerbl et al. 2023, equation 7), plus ``v log(MSE)`` where asked.

    The logarithm weighs every view by its relative error, as PSNR does: a view that is nearly right still counts.

    Args:
        image, truth, mask, form: as in ``ssim``.
        ssim_weight: w.
        log_weight: v, weight of the logarithm of the mean squared error, which is constant below ``LEAST_ERROR``.

    Returns:
        loss, l1 and ssim, scalars, each differentiable in ``image``. L1 is the mean absolute difference over valid
        pixels and channels. If no pixel is valid, l1 is 0, ssim is 1 and the gradient is zero. Non-finite values make
        the loss non-finite.

    Raises:
        ValueError: a shape, dtype or device is wrong; the message names the argument.
    """
    if image.ndim != 3 or image.dtype != torch.float32:
        raise ValueError(f"image must be [C, H, W] float32, got {list(image.shape)} {image.dtype}")
    if truth.shape != image.shape or truth.dtype != image.dtype or truth.device != image.device:
        raise ValueError(
            f"truth must be {list(image.shape)} {image.dtype} on {image.device} like image, "
            f"got {list(truth.shape)} {truth.dtype} on {truth.device}"
        )
    if mask is not None and (mask.shape != image.shape[1:] or mask.dtype != torch.bool or mask.device != image.device):
        raise ValueError(
            f"mask must be {list(image.shape[1:])} bool on {image.device}, "
            f"got {list(mask.shape)} {mask.dtype} on {mask.device}"
        )
    resolved = forms.chosen_form(form, image.device, GpuForm)
    needs_gradient = torch.is_grad_enabled() and image.requires_grad
    arguments = image, truth.detach(), mask, (ssim_weight, log_weight)
    if resolved == "cuda":
        return PhotometricTiles.apply(*arguments, needs_gradient)
    return _Photometric.apply(*arguments, resolved == "cpu", needs_gradient)


def _forward_bands(image: Tensor, truth: Tensor, mask: Tensor | None, partials: Tensor | None) -> Tensor:
    channels, height, _ = image.shape
    sums = image.new_empty(3, channels, height)
    bands = channels * -(-height // SSIM_BAND)
    launch(cpu_kernels.photometric, bands, image, truth, mask, sums, partials, grain=1)
    return sums


def _forward_pixels(image: Tensor, truth: Tensor, mask: Tensor | None, partials: Tensor | None) -> Tensor:
    channels, height, width = image.shape
    blurred = image.new_empty(4, *image.shape)
    values = image.new_empty(3, *image.shape)
    partials = image.new_empty(3, *image.shape) if partials is None else partials
    sums = image.new_empty(3, channels, height)
    count, masked = image.numel(), int(mask is not None)
    launch(kernels.blur_rows, count, image, truth, mask, masked, blurred)
    launch(kernels.photometric, count, image, truth, mask, masked, blurred, values, partials)
    launch(kernels.sum_rows, 3 * channels * height, values.view(3 * channels * height, width), sums.view(-1), grain=16)
    return sums


def _adjoint_pixels(
    image: Tensor, truth: Tensor, mask: Tensor | None, partials: Tensor, v_sums: Tensor, v_image: Tensor
) -> None:
    blurred, count = torch.empty_like(partials), image.numel()
    launch(kernels.blur_rows_adjoint, count, partials, blurred)
    masked = int(mask is not None)
    launch(kernels.photometric_adjoint, count, image, truth, mask, masked, blurred, v_sums, v_image)


Scores = tuple[tuple[Tensor, Tensor, Tensor], Any, Any]
"""Loss, L1 and SSIM; the number of values that count, and their mean squared error."""


def _scores_on_host(sums: Tensor, image: Tensor, mask: Tensor | None, ssim_weight: float, log_weight: float) -> Scores:
    """Combine the sums over rows [3, C, H], the few numbers in Python: torch takes longer for them."""
    totals = sums.flatten(1).double().sum(1).tolist()  # a few thousand values: one thread, one order
    valid = image.numel() if mask is None else int(mask.sum()) * image.shape[0]
    count = float(max(valid, 1))
    l1, similarity, error = (total / count for total in totals)
    similarity = similarity if valid else 1.0
    loss = (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - similarity)
    if log_weight:
        loss += log_weight * math.log(LEAST_ERROR if error < LEAST_ERROR else error)  # NaN is kept
    return (image.new_tensor(loss), image.new_tensor(l1), image.new_tensor(similarity)), count, error


def _scores_on_device(
    sums: Tensor, image: Tensor, mask: Tensor | None, ssim_weight: float, log_weight: float
) -> Scores:
    """Combine the sums over rows [3, C, H] without waiting for the device."""
    totals = sums.flatten(1).double().sum(1)
    count: Any = float(max(image.numel(), 1))
    if mask is not None:
        count = mask.sum().double() * image.shape[0]
        totals = torch.stack([totals[0], torch.where(count > 0, totals[1], 1.0), totals[2]])
        count = count.clamp(min=1.0)
    elif image.numel() == 0:
        totals[1] = 1.0
    l1, similarity, error = (totals / count).unbind()
    loss = (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - similarity)
    if log_weight:
        loss = loss + log_weight * error.clamp(min=LEAST_ERROR).log()
    return (loss.float(), l1.float(), similarity.float()), count, error


Gradients = tuple[Tensor | None, ...]
"""Of loss, L1 and SSIM."""


def _slopes_on_host(
    image: Tensor, gradients: Gradients, count: float, error: float, ssim_weight: float, log_weight: float
) -> Tensor:
    """Return the gradients [3] of the sums of L1, of SSIM and of squared errors."""
    v_loss, v_l1, v_ssim = (0.0 if v is None else float(v) for v in gradients)
    v_error = log_weight / error * v_loss if error > LEAST_ERROR else 0.0
    v_means = v_l1 + (1.0 - ssim_weight) * v_loss, v_ssim - ssim_weight * v_loss, v_error
    return image.new_tensor([v / count for v in v_means])


def _slopes_on_device(
    image: Tensor, gradients: Gradients, count: Any, error: Tensor, ssim_weight: float, log_weight: float
) -> Tensor:
    v_loss, v_l1, v_ssim = (torch.zeros_like(error) if v is None else v for v in gradients)
    v_error = torch.where(error > LEAST_ERROR, log_weight / error, 0.0) * v_loss
    v_means = torch.stack([v_l1 + (1.0 - ssim_weight) * v_loss, v_ssim - ssim_weight * v_loss, v_error])
    return (v_means / count).float()


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        truth: Tensor,
        mask: Tensor | None,
        weights: tuple[float, float],
        simd: bool,
        needs_gradient: bool,
    ) -> tuple[Tensor, Tensor, Tensor]:
        image, truth = image.detach().contiguous(), truth.contiguous()
        mask = None if mask is None else mask.contiguous()
        partials = image.new_empty(3, *image.shape) if needs_gradient else None
        if image.numel() == 0:
            sums = image.new_zeros(3, 1, 1)
        else:
            sums = (_forward_bands if simd else _forward_pixels)(image, truth, mask, partials)
        scores = _scores_on_device if image.is_cuda else _scores_on_host
        results, ctx.count, ctx.error = scores(sums, image, mask, *weights)
        ctx.save_for_backward(image, truth, mask, partials)
        ctx.weights, ctx.simd = weights, simd
        ctx.set_materialize_grads(False)
        return results

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        image, truth, mask, partials = ctx.saved_tensors
        v_image = torch.empty_like(image)
        if image.numel():
            slopes = _slopes_on_device if image.is_cuda else _slopes_on_host
            v_sums = slopes(image, gradients, ctx.count, ctx.error, *ctx.weights)
            if ctx.simd:
                bands = image.shape[0] * -(-image.shape[1] // SSIM_BAND)
                launch(cpu_kernels.photometric_adjoint, bands, image, truth, mask, partials, v_sums, v_image, grain=1)
            else:
                _adjoint_pixels(image, truth, mask, partials, v_sums, v_image)
        return v_image, None, None, None, None, None
