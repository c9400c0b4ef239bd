"""Random projected splats, drawn on the CPU so that all devices see the same numbers."""

from __future__ import annotations

import math

import torch

from scgs_warp.types import Splats


def random_splats(
    seed: int,
    n: int,
    width: int,
    height: int,
    device: torch.device | str = "cpu",
    *,
    log_scale: float = 1.0,
    aspect: float = 0.8,
    opacity: tuple[float, float] = (0.0, 1.0),
    sharpness: float = 0.0,
) -> Splats:
    """``n`` splats, most of them inside the image.

    Args:
        log_scale: mean of the logarithm of their standard deviations, in pixels.
        aspect: spread of that logarithm, from splat to splat and from axis to axis.
    """
    g = torch.Generator().manual_seed(seed)
    means = (torch.rand(n, 2, generator=g) * 1.2 - 0.1) * torch.tensor([float(width), float(height)])
    sigma = torch.exp(log_scale + aspect * torch.randn(n, 2, generator=g)).double()
    turn = math.pi * torch.rand(n, generator=g).double()
    R = torch.stack([turn.cos(), -turn.sin(), turn.sin(), turn.cos()], -1).view(n, 2, 2)
    covariance = R @ torch.diag_embed(sigma**2) @ R.transpose(1, 2) + 0.3 * torch.eye(2, dtype=torch.float64)
    inverse = torch.linalg.inv(covariance)
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1).float()
    low, high = opacity
    opacities = low + (high - low) * torch.rand(n, generator=g)
    depths = 1.0 + 3.0 * torch.rand(n, generator=g)
    diagonal = torch.diagonal(covariance, dim1=1, dim2=2)
    radii = torch.ceil(3.33 * diagonal.sqrt()).clamp(max=2**30).int()
    tensors = (means, conics.contiguous(), depths, opacities, radii)
    return Splats(*(t.to(device) for t in tensors), width=width, height=height, sharpness=sharpness)
