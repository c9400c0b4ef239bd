"""Distances between spheres and a silhouette, in plain torch, differentiable."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def project(means: Tensor, viewmat: Tensor, K: Tensor, width: int) -> Tensor:
    """[N, 2]: projected centres, in widths of the image; depths are 0.01 or more."""
    local = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    return (local @ K.T)[:, :2] / local[:, 2:].clamp_min(1e-2) / width


def silhouette(means: Tensor, viewmat: Tensor, K: Tensor, width: int, distances: Tensor, size: Tensor, pixels: Tensor):
    """Scalar: mean distance of the centres to the silhouette, plus that of its pixels to the nearest centre."""
    points = project(means, viewmat, K, width)
    grid = 2.0 * points / size - 1.0
    strayed = F.grid_sample(distances[None, None], grid[None, None], align_corners=False, padding_mode="border")
    apart = pixels[:, None] - points[None]
    nearest = apart.detach().square().sum(2).argmin(1)
    return strayed.mean() + apart[torch.arange(len(pixels)), nearest].norm(dim=1).mean()
