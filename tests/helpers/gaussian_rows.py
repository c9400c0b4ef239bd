"""A few Gaussians and their optimiser after one step, for tests of row operations."""

from __future__ import annotations

import torch
from torch import Tensor

from scgs_warp.gaussians import GaussianParameters, gaussians_from_points
from scgs_warp.optim import Adam

RATES = dict.fromkeys(GaussianParameters.NAMES, 1e-3)


def make(count: int, device: str, seed: int = 0) -> tuple[GaussianParameters, Adam]:
    """``count`` opaque Gaussians at random points, with non-zero moments of all parameters."""
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)).to(device)
    gaussians = gaussians_from_points(points, None, sh_degree=1, hyper_columns=2)
    with torch.no_grad():
        gaussians.opacity_logits.fill_(2.0)
    optimizer = Adam(dict(gaussians.named_parameters()), RATES)
    for parameter in gaussians.parameters():
        parameter.grad = torch.arange(parameter.numel(), device=device).reshape(parameter.shape).float() + 1.0
    optimizer.step()
    return gaussians, optimizer


def moments(optimizer: Adam, name: str) -> tuple[Tensor, Tensor]:
    """The parameter ``name`` and its first moment."""
    return optimizer.groups[name].parameter, optimizer.groups[name].exp_avg
