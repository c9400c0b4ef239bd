"""Operations on the spheres of stage 1: they are densified, pruned, and thinned to N_p, to become control points.

``density_control.py`` decides when.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from ..config.presets import TrainConfig
from ..gaussians import GaussianParameters
from ..motion.spheres import Spheres
from ..ops.sampling import farthest_points
from ..optim import Adam
from ..seeding import Purpose, generator
from ..types import Stats
from .gaussian_density import SPLIT_SHRINK, grow_and_prune, mean_gradient
from .initial_models import sphere_unit

TRAJECTORY_TIMES = 16
"""Number of instants in a trajectory. Farthest-point sampling chooses control points in the space of trajectories."""
DEAD_OPACITY = 0.01
"""Opacity below which a sphere is removed where a fixed share is cloned."""


def sphere_limit(config: TrainConfig) -> int:
    """Return the largest number of moving spheres, at least N_p."""
    return max(round(sphere_unit(config) * config.pretrain.max_ratio), config.motion.nodes)


def densify_spheres(
    gaussians: GaussianParameters,
    optimizer: Adam,
    spheres: Spheres,
    stats: Stats,
    config: TrainConfig,
    step: int,
) -> None:
    """Remove transparent spheres and clone a fixed share, those with the largest gradients, keeping between N_p and the
    cap. If fewer than N_p spheres are left (a short stage 1 can leave a dozen), more are cloned.
    """
    with torch.no_grad():
        opacities = gaussians.opacities()
        alive = (opacities >= DEAD_OPACITY) & torch.isfinite(gaussians.means).all(1)
        if not bool(alive.any()):
            alive[:] = True
        kept = torch.where(alive)[0]
        limit = sphere_limit(config)
        if len(kept) > limit and step + 1 >= config.pretrain.warm_up:
            kept = kept[opacities[kept].argsort(descending=True, stable=True)[:limit]].sort().values
        gradient = mean_gradient(stats)[kept]
        wanted = min(round(config.pretrain.clone_share * len(kept)), max(limit - len(kept), 0))
        wanted = max(wanted, config.motion.nodes - len(kept))
        parents = kept[gradient.argsort(descending=True, stable=True)]
        clone_spheres(
            gaussians, optimizer, spheres, kept, parents, wanted, generator(config.seed, Purpose.CLONED_SPHERES, step)
        )


def densify_spheres_by_gradient(
    gaussians: GaussianParameters,
    optimizer: Adam,
    spheres: Spheres,
    stats: Stats,
    config: TrainConfig,
    extent: float,
    step: int,
) -> None:
    """Clone or split the spheres whose mean gradient reaches ``pretrain.grad_threshold``, as Gaussians of the main
    stage, and remove transparent ones, keeping between N_p and the cap.

    As all spheres have one size, a round either clones or splits. A split shrinks that size as much as the halves
    shrink the geometric mean of all sizes. Pruning by size would remove all spheres at once, so there is none.

    Args:
        extent: radius of the cameras, normalised units.
    """
    with torch.no_grad():
        gaussians.log_scales.copy_(spheres.log_radius.expand(len(gaussians), 3))
    grow_and_prune(
        gaussians,
        optimizer,
        stats,
        replace(config.densify, max_gaussians=sphere_limit(config)),
        grad_threshold=config.pretrain.grad_threshold,
        extent=extent,
        prune_large=False,
        random=generator(config.seed, Purpose.SPLIT_SPHERES, step),
    )
    with torch.no_grad():
        halves = int((gaussians.log_scales[:, :1] < spheres.log_radius).sum())
        spheres.log_radius.data -= math.log(SPLIT_SHRINK) * halves / len(gaussians)
        kept = torch.arange(len(gaussians), device=gaussians.means.device)
        parents = gaussians.opacities().argsort(descending=True, stable=True)
        missing = max(config.motion.nodes - len(kept), 0)
        clone_spheres(
            gaussians, optimizer, spheres, kept, parents, missing, generator(config.seed, Purpose.CLONED_SPHERES, step)
        )


def clone_spheres(
    gaussians: GaussianParameters,
    optimizer: Adam,
    spheres: Spheres,
    kept: Tensor,
    parents: Tensor,
    count: int,
    random: torch.Generator,
) -> None:
    """Reduce spheres to the rows ``kept`` [N] and append ``count`` clones of the rows ``parents`` in their order, again
    from the first after the last. Each clone is displaced at random, by about one radius."""
    clones = parents[torch.arange(count, device=kept.device) % len(parents)]
    index = torch.cat([kept, clones])
    fresh = torch.arange(len(index), device=index.device) >= len(kept)
    optimizer.regather(gaussians, GaussianParameters.NAMES, index, fresh)
    if count:
        noise = torch.randn(count, 3, generator=random).to(clones.device)
        gaussians.means.data[len(kept) :] += noise * spheres.log_radius.detach().exp()
    spheres.graph = None


def thin_spheres(
    gaussians: GaussianParameters, optimizer: Adam, spheres: Spheres, nodes: int, solid_opacity: float = 0.1
) -> None:
    """Reduce spheres to N_p by farthest-point sampling in trajectory space, so that parts that move apart are both
    sampled.

    Only spheres of at least ``solid_opacity`` are sampled if there are enough, because the farthest spheres are often
    strays in empty space.
    """
    if len(gaussians) <= nodes:
        return
    with torch.no_grad():
        opacities = gaussians.opacities()
        count = max(int((opacities >= solid_opacity).sum()), nodes)
        kept = opacities.argsort(descending=True, stable=True)[:count].sort().values
        times = torch.linspace(0.0, 1.0, TRAJECTORY_TIMES)
        tracks = gaussians.means + spheres.translations(gaussians.means, times)
        flat = tracks.permute(1, 0, 2).reshape(len(gaussians), -1)[kept].contiguous()
        index = kept[farthest_points(flat, nodes).to(flat.device)]
    optimizer.regather(gaussians, GaussianParameters.NAMES, index, torch.zeros_like(index, dtype=torch.bool))
    spheres.graph = None
