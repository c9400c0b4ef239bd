"""SSIM and the photometric loss, slowly: float64, one dense 11 x 11 window, torch's convolution, autograd."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import conv2d


def _window() -> Tensor:
    offsets = torch.arange(-5, 6, dtype=torch.float64)
    weights = torch.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    return (weights / weights.sum())[None, None]


def ssim_map(image: Tensor, truth: Tensor) -> Tensor:
    """[C, H, W] SSIM of every pixel, by the definition of means, variances and covariance (Wang et al. 2004)."""

    def blur(maps: Tensor) -> Tensor:
        return conv2d(maps[:, None], _window(), padding=5)[:, 0]

    mean_x, mean_y = blur(image), blur(truth)
    variance_x = blur(image**2) - mean_x**2
    variance_y = blur(truth**2) - mean_y**2
    covariance = blur(image * truth) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + 0.01**2) / (mean_x**2 + mean_y**2 + 0.01**2)
    return luminance * (2 * covariance + 0.03**2) / (variance_x + variance_y + 0.03**2)


def photometric_loss(
    image: Tensor,
    truth: Tensor,
    mask: Tensor | None = None,
    ssim_weight: float = 0.2,
    log_weight: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """loss, l1, ssim in float64; invalid pixels are replaced by the truth and left out of the means."""
    image, truth = image.double(), truth.double()
    mask = torch.ones(image.shape[1:], dtype=torch.bool) if mask is None else mask
    if not mask.any():
        return image.sum() * 0, image.sum() * 0, image.sum() * 0 + 1
    image = torch.where(mask, image, truth)
    l1 = (image - truth).abs()[:, mask].mean()
    ssim = ssim_map(image, truth)[:, mask].mean()
    error = ((image - truth) ** 2)[:, mask].mean()
    logarithm = log_weight * error.clamp(min=1e-7).log()
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim) + logarithm, l1, ssim
