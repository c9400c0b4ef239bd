"""Initial models of both stages, and the spheres of stage 1: densified, pruned, and reduced to N_p control points."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..config.presets import TrainConfig
from ..gaussians import SH_C0, GaussianParameters, gaussians_from_points, neighbor_distance
from ..motion import HexPlane, Motion, build_motion
from ..motion.control_points import ControlPoints, heads_of, make_network
from ..motion.spheres import Spheres
from ..ops.sampling import farthest_points
from ..optim import Adam
from ..seeding import generator
from ..types import Stats
from .densify import mean_gradient

TRAJECTORY_TIMES = 16
"""Number of instants in a trajectory. Farthest-point sampling chooses control points in the space of trajectories."""
START_RADIUS = 0.5
"""Radius of the spheres at the start of progressive pre-training, as a share of their spacing."""
DEAD_OPACITY = 0.01
"""Opacity below which a sphere is removed."""
SOLID_OPACITY = 0.1
"""Opacity below which a sphere is not used to place control points or Gaussians, if there are enough others."""
FEWEST_SPHERES = 256
"""Smallest number of control points from which sphere counts are derived: fewer spheres cannot represent a figure."""


def sphere_unit(config: TrainConfig) -> int:
    """Return the number of control points from which sphere counts are derived: N_p, but at least
    ``FEWEST_SPHERES``."""
    return max(config.motion.nodes, FEWEST_SPHERES)


def initial_spheres(
    config: TrainConfig, points: Tensor, colors: Tensor, device: str
) -> tuple[GaussianParameters, Spheres]:
    """Make spheres at a sample of ``points`` [P, 3] (``start_ratio`` per control point) with ``colors`` [P, 3], and a
    network without motion.

    The sample is spread evenly, because over all frames a limb may be anywhere. Progressive pre-training starts with
    the first pose: there the sample is as dense as the points, and the spheres are smaller than their spacing, because
    a sphere that sticks out of a thin limb would turn transparent before it shrinks.
    """
    count = min(round(sphere_unit(config) * config.pretrain.start_ratio), len(points))
    index = torch.arange(count, device=points.device)
    if not config.pretrain.progressive and count < len(points):
        index = farthest_points(points, count)
    chosen = points[index]
    gaussians = gaussians_from_points(chosen, colors[index], sh_degree=0, hyper_dim=0)
    share = START_RADIUS if config.pretrain.progressive else 1.0
    radius = share * float(neighbor_distance(chosen).median())
    network = make_network(config.motion, heads_of(config.motion), config.seed).to(device)
    return gaussians, Spheres(network, radius).to(device)


def initial_motion(config: TrainConfig, points: Tensor, times: int = 0) -> Motion:
    """Make a motion model for a run without stage 1; its control points are a sample of ``points`` [P, 3], without
    motion.

    Args:
        times: number of distinct training times, which determines the size of feature planes.
    """
    if config.motion.model == "hexplane":
        return HexPlane(config.seed, config.motion.plane_times or max(2, times // 2))
    if config.motion.model != "control-points":
        return build_motion(config.motion.model, config)
    positions = points[farthest_points(points, min(config.motion.nodes, len(points)))]
    radii = torch.full((len(positions),), float(neighbor_distance(positions).median()), device=points.device)
    network = make_network(config.motion, heads_of(config.motion), config.seed)
    return ControlPoints(positions, radii, network, config.motion)


def densify_spheres(
    gaussians: GaussianParameters,
    optimizer: Adam,
    spheres: Spheres,
    stats: Stats,
    config: TrainConfig,
    step: int,
) -> None:
    """Remove transparent spheres and clone those with the largest gradients, keeping between N_p and the cap.

    The gradient threshold for Gaussians does not suit large spheres, so a fixed share is cloned. Each clone is
    displaced at random, by about one radius. If fewer than N_p spheres are left (a short stage 1 can leave a dozen),
    more are cloned.
    """
    with torch.no_grad():
        opacities = gaussians.opacities()
        alive = (opacities >= DEAD_OPACITY) & torch.isfinite(gaussians.means).all(1)
        if not bool(alive.any()):
            alive[:] = True
        kept = torch.where(alive)[0]
        limit = round(sphere_unit(config) * config.pretrain.max_ratio)
        if len(kept) > limit and step + 1 >= config.pretrain.warm_up:
            kept = kept[opacities[kept].argsort(descending=True, stable=True)[:limit]].sort().values
        gradient = mean_gradient(stats)[kept]
        wanted = min(round(config.pretrain.clone_share * len(kept)), max(limit - len(kept), 0))
        wanted = max(wanted, config.motion.nodes - len(kept))
        parents = kept[gradient.argsort(descending=True, stable=True)]
        clones = parents[torch.arange(wanted, device=kept.device) % len(parents)]
        index = torch.cat([kept, clones])
        fresh = torch.arange(len(index), device=index.device) >= len(kept)
        optimizer.regather(gaussians, GaussianParameters.NAMES, index, fresh)
        if wanted:
            noise = torch.randn(wanted, 3, generator=generator(config.seed, 32, step)).to(clones.device)
            gaussians.means.data[len(kept) :] += noise * spheres.log_radius.exp()
        spheres.graph = None


def thin_spheres(gaussians: GaussianParameters, optimizer: Adam, spheres: Spheres, nodes: int) -> None:
    """Reduce spheres to N_p by farthest-point sampling in trajectory space, so that parts that move apart are both
    sampled.

    Only solid spheres are sampled if there are enough, because the farthest spheres are often strays in empty space.
    """
    if len(gaussians) <= nodes:
        return
    with torch.no_grad():
        opacities = gaussians.opacities()
        count = max(int((opacities >= SOLID_OPACITY).sum()), nodes)
        kept = opacities.argsort(descending=True, stable=True)[:count].sort().values
        times = torch.linspace(0.0, 1.0, TRAJECTORY_TIMES)
        tracks = gaussians.means + spheres.translations(gaussians.means, times)
        flat = tracks.permute(1, 0, 2).reshape(len(gaussians), -1)[kept].contiguous()
        index = kept[farthest_points(flat, nodes).to(flat.device)]
    optimizer.regather(gaussians, GaussianParameters.NAMES, index, torch.zeros_like(index, dtype=torch.bool))
    spheres.graph = None


def control_points_from_spheres(gaussians: GaussianParameters, spheres: Spheres, config: TrainConfig) -> ControlPoints:
    """Make control points at the spheres' centres, all with the same initial radius.

    The radius is that of the spheres, but at least their typical spacing, so that neighbours blend.
    """
    positions = gaussians.means.detach()
    spacing = float(neighbor_distance(positions).median())
    radius = max(float(spheres.log_radius.detach().exp()), spacing)
    radii = torch.full((len(positions),), radius, device=positions.device)
    return ControlPoints(positions, radii, spheres.network, config.motion)


def initial_gaussians(
    config: TrainConfig, points: Tensor, colors: Tensor, spheres: tuple[GaussianParameters, Spheres] | None = None
) -> GaussianParameters:
    """Make the Gaussians of stage 2 at ``points`` [P, 3] with ``colors`` [P, 3], or around the spheres."""
    options: dict[str, Any] = {
        "sh_degree": config.sh_degree,
        "hyper_dim": config.motion.hyper_dim + config.motion.mask,
        "shaded": config.motion.has_shading,
        "corrected": config.motion.has_correctives,
    }
    count = min(config.init_points, config.densify.max_gaussians)
    if spheres is None or config.init_from == "points":
        return gaussians_from_points(points[:count], colors[:count], **options)
    parents, motion = spheres
    with torch.no_grad():
        opaque = torch.where(parents.opacities() >= SOLID_OPACITY)[0]
        opaque = opaque if len(opaque) else torch.arange(len(parents), device=opaque.device)
        random = generator(config.seed, 34)
        chosen = opaque[torch.randint(len(opaque), (count,), generator=random).to(opaque.device)]
        offsets = torch.randn(count, 3, generator=random).to(chosen.device) * motion.log_radius.exp()
        colors = (parents.sh_dc[chosen] * SH_C0 + 0.5).clamp(0.0, 1.0)
        return gaussians_from_points(parents.means[chosen] + offsets, colors, **options)
