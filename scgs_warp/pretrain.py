"""Stage 1: find the control points. Spheres are grown and pruned, thinned to N_p, trained on, and handed to stage 2."""

from __future__ import annotations

import torch
from torch import Tensor

from .config import TrainConfig
from .densify import mean_gradient, threshold
from .gaussians import SH_C0, GaussianParameters, gaussians_from_points, neighbor_distance
from .motion.control_points import ControlPoints, heads_of, make_network
from .motion.spheres import Spheres
from .ops.sampling import farthest_points
from .optim import generator, regather
from .types import Stats

SCENE_HALF_SIZE = 1.3
"""Half the edge of the cube in which a scene without initial points starts (normalised units)."""
TRAJECTORY_TIMES = 16
"""Instants whose positions make the space in which farthest-point sampling chooses control points."""
DEAD_OPACITY = 0.01


def random_points(count: int, seed: int, key: int) -> Tensor:
    """[count, 3] uniform in the cube."""
    return (torch.rand(count, 3, generator=generator(seed, key)) * 2.0 - 1.0) * SCENE_HALF_SIZE


def begin_spheres(config: TrainConfig, points: Tensor | None, device: str) -> tuple[GaussianParameters, Spheres]:
    """Spheres at a farthest-point sample of the data's points, else at random, and the network at rest."""
    count = round(config.motion.nodes * config.pretrain.max_ratio)
    if points is None or len(points) < config.motion.nodes:
        chosen = random_points(count, config.seed, 31).to(device)
    else:
        chosen = points[farthest_points(points, min(count, len(points)))]
    gaussians = gaussians_from_points(chosen, None, sh_degree=0, hyper_dim=0)
    radius = float(neighbor_distance(chosen).median())
    network = make_network(config.motion, heads_of(config.motion), config.seed).to(device)
    return gaussians, Spheres(network, radius).to(device)


def densify_spheres(
    gaussians: GaussianParameters,
    optimizer: torch.optim.Adam,
    spheres: Spheres,
    stats: Stats,
    config: TrainConfig,
    size: tuple[int, int],
    step: int,
) -> None:
    """Remove transparent spheres, clone those that the image pulls at, keep between N_p and the cap.

    The clone lands within a radius of its parent. Too few left (a short first stage can fall to a dozen): the most
    opaque ones are cloned in turn.
    """
    with torch.no_grad():
        opacities = gaussians.opacities()
        alive = (opacities >= DEAD_OPACITY) & torch.isfinite(gaussians.means).all(1)
        if not bool(alive.any()):
            alive[:] = True
        kept = torch.where(alive)[0]
        gradient = mean_gradient(stats)[kept]
        limit = round(config.motion.nodes * config.pretrain.max_ratio)
        order = gradient.argsort(descending=True, stable=True)
        wanted = order[gradient[order] >= threshold_of(config, size)][: max(limit - len(kept), 0)]
        clones = kept[wanted]
        missing = config.motion.nodes - len(kept) - len(clones)
        if missing > 0:
            donors = kept[opacities[kept].argsort(descending=True, stable=True)]
            clones = torch.cat([clones, donors[torch.arange(missing, device=donors.device) % len(donors)]])
        index = torch.cat([kept, clones])
        fresh = torch.arange(len(index), device=index.device) >= len(kept)
        regather(optimizer, gaussians, GaussianParameters.NAMES, index, fresh)
        if len(clones):
            noise = torch.randn(len(clones), 3, generator=generator(config.seed, 32, step)).to(clones.device)
            gaussians.means.data[len(kept) :] += noise * spheres.log_radius.exp()
        spheres.graph = None


def threshold_of(config: TrainConfig, size: tuple[int, int]) -> float:
    """The sphere threshold follows the resolution as the Gaussians' does."""
    ratio = config.pretrain.grad_threshold / config.densify.grad_threshold
    return ratio * threshold(config.densify, *size)


def thin_spheres(gaussians: GaussianParameters, optimizer: torch.optim.Adam, spheres: Spheres, nodes: int) -> None:
    """Farthest-point sampling to N_p in trajectory space, so that parts that move apart are both represented."""
    if len(gaussians) <= nodes:
        return
    with torch.no_grad():
        times = torch.linspace(0.0, 1.0, TRAJECTORY_TIMES)
        tracks = gaussians.means + spheres.translations(gaussians.means, times)
        flat = tracks.permute(1, 0, 2).reshape(len(gaussians), -1).contiguous()
        index = farthest_points(flat, nodes).to(flat.device)
    regather(optimizer, gaussians, GaussianParameters.NAMES, index, torch.zeros_like(index, dtype=torch.bool))
    spheres.graph = None


def control_points_of(gaussians: GaussianParameters, spheres: Spheres, config: TrainConfig) -> ControlPoints:
    """The spheres' centres become control points. All start with one radius (seed S4: o_i is shared): the spheres' own,
    but no less than their typical spacing, so that neighbours blend."""
    positions = gaussians.means.detach()
    spacing = float(neighbor_distance(positions).median())
    radius = max(float(spheres.log_radius.detach().exp()), spacing)
    radii = torch.full((len(positions),), radius, device=positions.device)
    return ControlPoints(positions, radii, spheres.network, config.motion)


def begin_gaussians(
    config: TrainConfig, points: Tensor | None, spheres: tuple[GaussianParameters, Spheres] | None, device: str
) -> GaussianParameters:
    """The Gaussians of stage 2: at the data's points, else around the spheres, else at random."""
    options = {"sh_degree": config.sh_degree, "hyper_dim": config.motion.hyper_dim}
    count = min(config.init_points, config.densify.max_gaussians)
    if points is not None:
        return gaussians_from_points(points[:count], None, **options)
    if spheres is None or config.init_from == "random":
        return gaussians_from_points(random_points(count, config.seed, 33).to(device), None, **options)
    parents, motion = spheres
    with torch.no_grad():
        opaque = torch.where(parents.opacities() >= 0.1)[0]
        opaque = opaque if len(opaque) else torch.arange(len(parents), device=opaque.device)
        random = generator(config.seed, 34)
        chosen = opaque[torch.randint(len(opaque), (count,), generator=random).to(opaque.device)]
        offsets = torch.randn(count, 3, generator=random).to(chosen.device) * motion.log_radius.exp()
        colors = (parents.sh_dc[chosen] * SH_C0 + 0.5).clamp(0.0, 1.0)
        return gaussians_from_points(parents.means[chosen] + offsets, colors, **options)
