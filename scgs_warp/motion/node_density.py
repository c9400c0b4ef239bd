"""Adaptive density of control points: clone those with large gradients, prune those with little influence (paper
section 4.3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..gaussians import GaussianParameters
from ..optim import Adam
from .control_points import NODE_NAMES, ControlPoints


class Influence(NamedTuple):
    """Statistics of the Gaussians that each control point moves, float64."""

    impact: np.ndarray
    """[M] sum of the Gaussians' weights."""
    gradient: np.ndarray
    """[M] weighted mean of the Gaussians' screen-space gradients."""
    centre: np.ndarray
    """[M, 3] mean position of the Gaussians, weighted by weight and gradient: the position of a clone."""


def influence(motion: ControlPoints, gaussians: GaussianParameters, gradient: Tensor) -> Influence:
    """Compute the statistics of each control point. ``bincount`` adds in row order, regardless of the number of
    threads."""
    with torch.no_grad():
        indices, weights = motion.binding(gaussians)
    flat = indices.cpu().numpy().ravel()
    weight = weights.detach().cpu().double().numpy().ravel()
    pull = weight * np.repeat(gradient.cpu().double().numpy(), indices.shape[1])
    means = np.repeat(gaussians.means.detach().cpu().double().numpy(), indices.shape[1], axis=0)
    count = len(motion)
    impact = np.bincount(flat, weight, count)
    pulled = np.bincount(flat, pull, count)
    centre = np.stack([np.bincount(flat, pull * means[:, axis], count) for axis in range(3)], axis=1)
    return Influence(impact, pulled / np.maximum(impact, 1e-7), centre / np.maximum(pulled, 1e-30)[:, None])


def adapt_control_points(
    motion: ControlPoints,
    optimizer: Adam,
    gaussians: GaussianParameters,
    gradient: Tensor,
    *,
    grad_threshold: float,
    least_impact: float = 1e-2,
    growth: float = 0.1,
) -> tuple[int, int]:
    """Change the number of control points in place. At least K + 1 remain, those with the largest impact.

    Args:
        motion, optimizer: changed; clones inherit radius, weight and hyper-coordinates, with zero moments.
        gaussians: bound to the control points.
        gradient: [N] mean screen-space gradient of each Gaussian, normalised device coordinates.
        grad_threshold: clone a control point whose weighted mean gradient exceeds this.
        least_impact: prune a control point whose weights sum to less than this.
        growth: clone at most this share of the control points, those with the largest gradients, but at least one.

    Returns:
        Number of clones, and number of pruned control points.
    """
    sums = influence(motion, gaussians, gradient)
    keep = sums.impact >= least_impact
    fewest = motion.config.neighbors + 1
    if keep.sum() < fewest:
        keep[np.argsort(-sums.impact, kind="stable")[:fewest]] = True
    wanted = keep & (sums.gradient > grad_threshold) & np.isfinite(sums.centre).all(axis=1)
    most = max(1, int(growth * len(motion)))
    cloned = np.argsort(-np.where(wanted, sums.gradient, -1.0), kind="stable")[: min(most, int(wanted.sum()))]
    kept = np.nonzero(keep)[0]
    if len(cloned) == 0 and len(kept) == len(motion):
        return 0, 0
    device = motion.positions.device
    index = torch.from_numpy(np.concatenate([kept, cloned])).to(device)
    fresh = torch.arange(len(index), device=device) >= len(kept)
    names = tuple(name for name in NODE_NAMES if name != "strength_logits" or motion.config.node_weight)
    pruned = len(motion) - len(kept)
    optimizer.regather(motion, names, index, fresh)
    centres = torch.from_numpy(sums.centre[cloned]).to(motion.positions)
    motion.positions.data[len(kept) :] = centres
    motion.graph = None
    return len(cloned), pruned
