"""Row operations on Gaussians and their optimiser: grow, clone, split, prune, reset (3D-GS section 5).

``density_control.py`` decides when and on which rows.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..config.presets import DensifyConfig
from ..gaussians import GaussianParameters
from ..geometry.rotation import rotate
from ..optim import Adam
from ..types import Stats

SPLIT_SHRINK = 1.6
"""Ratio of a split Gaussian's scales to those of each of its two halves (3D-GS)."""
RESET_OPACITY = 0.01


def mean_gradient(stats: Stats) -> Tensor:
    """Return the [N] mean norm of the screen-space gradient over the images in which the Gaussian was drawn."""
    return torch.nan_to_num(stats.grad_norm / stats.count.clamp(min=1.0), nan=0.0, posinf=0.0)


def grow_and_prune(
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
    """Clone small Gaussians and split large ones whose mean gradient reaches the threshold, then prune.

    Args:
        gaussians, optimizer: changed in place; new rows start with zero moments.
        stats: statistics accumulated since the last round; the caller resets them.
        grad_threshold: norm of the screen-space gradient, normalised device coordinates.
        extent: radius of the cameras, normalised units.
        prune_large: also remove Gaussians that are too large on screen or in space; True only after the first opacity
            reset.
        random: generator for the positions of split halves.
    """
    with torch.no_grad():
        # Grow, within the budget.
        gradient = mean_gradient(stats)
        growing = _within_budget(gradient, gradient >= grad_threshold, config.max_gaussians - len(gaussians))
        large = gaussians.scales().amax(1) > config.percent_dense * extent
        index, fresh = clone_and_split(gaussians, optimizer, growing & ~large, growing & large, random)

        # Prune by opacity and by size.
        keep, scales = gaussians.opacities() >= config.min_opacity, gaussians.scales()
        if prune_large:
            if config.max_screen > 0:
                keep &= (stats.max_radii[index] <= config.max_screen) | fresh
            keep &= scales.amax(1) <= config.max_scale * extent
        # A non-finite Gaussian is never drawn, so no gradient could correct it.
        for values in (*(getattr(gaussians, name) for name in GaussianParameters.NAMES), scales):
            keep &= torch.isfinite(values).flatten(1).all(dim=1) if values.ndim > 1 else torch.isfinite(values)
    prune(gaussians, optimizer, keep)


def _within_budget(gradient: Tensor, chosen: Tensor, budget: int) -> Tensor:
    """Reduce ``chosen`` [N] bool to at most ``budget`` rows, those with the largest gradients."""
    if int(chosen.sum()) <= budget:
        return chosen
    best = torch.where(chosen, gradient, gradient.new_tensor(-1.0)).argsort(descending=True, stable=True)
    allowed = torch.zeros_like(chosen)
    allowed[best[: max(budget, 0)]] = True
    return allowed & chosen


def clone_and_split(
    gaussians: GaussianParameters, optimizer: Adam, clone: Tensor, split: Tensor, random: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Append a copy of each cloned row, and replace each split row by two smaller halves.

    Args:
        clone, split: [N] bool, disjoint.
        random: generator for the positions of the halves.

    Returns:
        The source row [M] of each Gaussian, and [M] bool, True for new rows, which come last and have zero moments.
    """
    pieces = [torch.where(~split)[0], torch.where(clone)[0], torch.where(split)[0].repeat(2)]
    index = torch.cat(pieces)
    fresh = torch.zeros(len(index), dtype=torch.bool, device=index.device)
    fresh[len(pieces[0]) :] = True
    optimizer.regather(gaussians, GaussianParameters.NAMES, index, fresh)
    _spread_halves(gaussians, len(pieces[2]), random)
    return index, fresh


def _spread_halves(gaussians: GaussianParameters, count: int, random: torch.Generator) -> None:
    """Sample the positions of the last ``count`` rows, copies of split Gaussians, from their parents, and shrink
    them."""
    if count == 0:
        return
    tail = slice(len(gaussians) - count, None)
    scales = gaussians.scales()[tail]
    offsets = torch.randn(count, 3, generator=random).to(scales.device) * scales
    gaussians.means.data[tail] += rotate(gaussians.quats[tail], offsets)
    gaussians.log_scales.data[tail] -= math.log(SPLIT_SHRINK)


def prune(gaussians: GaussianParameters, optimizer: Adam, keep: Tensor) -> Tensor:
    """Remove the rows not marked in ``keep`` [N] bool; if no row is marked, keep the most opaque one.

    Returns:
        Indices [M] of the rows that were kept.
    """
    if not bool(keep.any()):
        keep = keep.clone()
        keep[int(gaussians.opacity_logits.nan_to_num(-torch.inf, neginf=-torch.inf).argmax())] = True
    index = torch.where(keep)[0]
    if len(index) == len(keep):
        return index
    fresh = torch.zeros(len(index), dtype=torch.bool, device=index.device)
    optimizer.regather(gaussians, GaussianParameters.NAMES, index, fresh)
    return index


def reset_opacities(gaussians: GaussianParameters, optimizer: Adam) -> None:
    """Limit all opacities to 0.01. Gaussians that the images need become opaque again; floaters do not."""
    with torch.no_grad():
        gaussians.opacity_logits.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    optimizer.reset_moments("opacity_logits")
