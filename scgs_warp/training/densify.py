"""Grow, split, prune, reset: from statistics and thresholds to new rows (3D-GS section 5; seed S4)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..config.presets import DensifyConfig
from ..gaussians import GaussianParameters
from ..geometry.rotation import rotate
from ..optim import Adam
from ..runtime import memory
from ..types import Stats

SPLIT_SHRINK = 1.6
"""A split Gaussian's two halves are this much smaller (3D-GS)."""
RESET_OPACITY = 0.01
NUMBERS_PER_PARAMETER = 6
"""float32 in memory for each parameter: itself, its gradient, two moments, the posed value and its gradient."""
NUMBERS_OF_A_STEP = 220
"""float32 in memory for each Gaussian: its splat, its gradients, and what four pairs of splat and tile take."""


def threshold(config: DensifyConfig, width: int, height: int) -> float:
    """Gradient threshold at this image size."""
    return config.grad_threshold * (800.0 / math.sqrt(width * height)) ** config.resolution_exponent


def most_that_fit(gaussians: GaussianParameters, wanted: int) -> int:
    """How many Gaussians memory allows, at most ``wanted``: with their gradients, Adam's moments, what a step computes
    of each, and the pairs of splat and tile that each has on average."""
    count = len(gaussians)
    numbers = sum(parameter.numel() for parameter in gaussians.parameters()) / max(count, 1)
    each = round(4 * (NUMBERS_PER_PARAMETER * numbers + NUMBERS_OF_A_STEP))
    device = gaussians.means.device
    if memory.fits(each * max(min(wanted, 2 * count) - count, 0), device):  # no densification more than doubles them
        return wanted
    return min(wanted, count + memory.room(device) // each)


def mean_gradient(stats: Stats) -> Tensor:
    """[N] mean norm of the screen-space gradient over the images that saw the Gaussian."""
    return torch.nan_to_num(stats.grad_norm / stats.count.clamp(min=1.0), nan=0.0, posinf=0.0)


def densify(
    gaussians: GaussianParameters,
    optimizer: Adam,
    stats: Stats,
    config: DensifyConfig,
    *,
    grad_threshold: float,
    extent: float,
    prune_large: bool,
    random: torch.Generator,
) -> None:
    """Clone small Gaussians and split large ones whose mean gradient exceeds the threshold, then prune.

    Args:
        gaussians, optimizer: changed in place; new rows start with zero moments.
        stats: since the last call; the caller makes new ones.
        extent: radius of the cameras, normalised units.
        prune_large: also remove what is too large on screen or in space (after the first opacity reset).
        random: where split halves land.
    """
    with torch.no_grad():
        gradient = mean_gradient(stats)
        chosen = _within_budget(gradient, gradient >= grad_threshold, config.max_gaussians - len(gaussians))
        large = gaussians.scales().amax(1) > config.percent_dense * extent
        split, clone = chosen & large, chosen & ~large
        pieces = [torch.where(~split)[0], torch.where(clone)[0], torch.where(split)[0].repeat(2)]
        index = torch.cat(pieces)
        fresh = torch.zeros(len(index), dtype=torch.bool, device=index.device)
        fresh[len(pieces[0]) :] = True
        optimizer.regather(gaussians, GaussianParameters.NAMES, index, fresh)
        _spread_halves(gaussians, len(pieces[2]), random)
        keep = _worth_keeping(gaussians, stats.max_radii[index], fresh, config, extent, prune_large)
    prune(gaussians, optimizer, keep)


def _within_budget(gradient: Tensor, chosen: Tensor, budget: int) -> Tensor:
    """At most ``budget`` of the chosen ones, those with the largest gradient."""
    if int(chosen.sum()) <= budget:
        return chosen
    best = torch.where(chosen, gradient, gradient.new_tensor(-1.0)).argsort(descending=True, stable=True)
    allowed = torch.zeros_like(chosen)
    allowed[best[: max(budget, 0)]] = True
    return allowed & chosen


def _spread_halves(gaussians: GaussianParameters, count: int, random: torch.Generator) -> None:
    """The last ``count`` rows are halves of split Gaussians: sampled from their parents, and smaller."""
    if count == 0:
        return
    tail = slice(len(gaussians) - count, None)
    scales = gaussians.scales()[tail]
    offsets = torch.randn(count, 3, generator=random).to(scales.device) * scales
    gaussians.means.data[tail] += rotate(gaussians.quats[tail], offsets)
    gaussians.log_scales.data[tail] -= math.log(SPLIT_SHRINK)


def _worth_keeping(
    gaussians: GaussianParameters,
    max_radii: Tensor,
    fresh: Tensor,
    config: DensifyConfig,
    extent: float,
    prune_large: bool,
) -> Tensor:
    keep, scales = gaussians.opacities() >= config.min_opacity, gaussians.scales()
    if prune_large:
        keep &= (max_radii <= config.max_screen) | fresh
        keep &= scales.amax(1) <= config.max_scale * extent
    # What is not finite is never drawn, so it would have no gradient that could mend it.
    for values in (*(getattr(gaussians, name) for name in GaussianParameters.NAMES), scales):
        keep &= torch.isfinite(values).flatten(1).all(dim=1) if values.ndim > 1 else torch.isfinite(values)
    return keep


def prune(gaussians: GaussianParameters, optimizer: Adam, keep: Tensor) -> Tensor:
    """Keep the rows marked in ``keep`` [N]; if that would leave none, keep the most opaque one. Returns the rows."""
    if not bool(keep.any()):
        keep = keep.clone()
        keep[int(gaussians.opacity_logits.nan_to_num(-torch.inf, neginf=-torch.inf).argmax())] = True
    index = torch.where(keep)[0]
    if len(index) == len(keep):
        return index
    fresh = torch.zeros(len(index), dtype=torch.bool, device=index.device)
    optimizer.regather(gaussians, GaussianParameters.NAMES, index, fresh)
    return index


def resets(config: DensifyConfig, done: int) -> bool:
    """Whether opacities are reset after ``done`` main steps: that needs time to heal before densification ends."""
    every = config.opacity_reset_every
    return done % every == 0 and done + every // 2 <= config.until


def prunes_unseen(config: DensifyConfig, done: int) -> bool:
    """Whether Gaussians are judged by what they make up of the images after ``done`` main steps. A reset spares what is
    hidden: all surfaces are transparent then, and the inside is coloured again."""
    return config.min_contribution > 0.0 and (done == config.until or resets(config, done))


def reset_opacities(gaussians: GaussianParameters, optimizer: Adam) -> None:
    """No opacity above 0.01 any more: what the images need comes back, floaters do not."""
    with torch.no_grad():
        gaussians.opacity_logits.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    optimizer.reset_moments("opacity_logits")
