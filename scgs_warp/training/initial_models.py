"""Models with which a stage begins: spheres from points, control points from spheres, Gaussians from either."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ..config.presets import TrainConfig
from ..gaussians import SH_C0, GaussianParameters, gaussians_from_points, neighbor_distance
from ..motion import HexPlane, Motion, build_motion
from ..motion.control_points import ControlPoints, heads_of, make_network
from ..motion.spheres import Spheres
from ..ops.sampling import farthest_points
from ..seeding import Purpose, generator

START_RADIUS = 0.5
"""Radius of the spheres at the start of progressive pre-training, as a share of their spacing."""
FEWEST_SPHERES = 256
"""Smallest number of control points from which sphere counts are derived: fewer spheres cannot represent a figure."""


def sphere_unit(config: TrainConfig) -> int:
    """Return the number of control points from which sphere counts are derived: N_p, but at least ``FEWEST_SPHERES``
    where a fixed share is cloned."""
    return max(config.motion.nodes, FEWEST_SPHERES if config.pretrain.densify_by == "share" else 1)


def starts_in_first_pose(config: TrainConfig) -> bool:
    """Decide whether spheres begin in the pose of the first frames, from which they follow the motion frame by
    frame."""
    return config.pretrain.progressive and config.pretrain.progressive_by == "frame"


def initial_spheres(
    config: TrainConfig, points: Tensor, colors: Tensor, device: str, largest: float = math.inf
) -> tuple[GaussianParameters, Spheres]:
    """Make spheres at a sample of ``points`` [P, 3] (``start_ratio`` per control point) with ``colors`` [P, 3], and a
    network without motion.

    The sample is spread evenly, because over all frames a limb may be anywhere. Progressive pre-training frame by frame
    starts with the first pose: there the sample is as dense as the points, and the spheres are smaller than their
    spacing, because a sphere that sticks out of a thin limb would turn transparent before it shrinks.

    Args:
        largest: limit on the radius of the spheres, normalised.
    """
    pretrain = config.pretrain
    count = min(round(sphere_unit(config) * pretrain.start_ratio), len(points))
    index = torch.arange(count, device=points.device)
    first_pose = starts_in_first_pose(config)
    if not first_pose and count < len(points):
        index = farthest_points(points, count)
    chosen = points[index]
    shown = None if pretrain.grey else colors[index]
    gaussians = gaussians_from_points(chosen, shown, sh_degree=0, hyper_columns=0)
    share = START_RADIUS if first_pose else 1.0
    radius = min(share * float(neighbor_distance(chosen).median()), largest)
    network = make_network(config.motion, heads_of(config.motion), config.seed).to(device)
    return gaussians, Spheres(network, radius).to(device)


def initial_motion(config: TrainConfig, points: Tensor, times: int = 0, moves: Tensor | None = None) -> Motion:
    """Make a motion model for a run without stage 1; its control points are a sample of ``points`` [P, 3], without
    motion.

    Args:
        times: number of distinct training times, which determines the size of feature planes.
        moves: [P] bool, the points that are known to move; half of the control points are among them.
    """
    if config.motion.model == "hexplane":
        return HexPlane(config.seed, config.motion.plane_times or max(2, times // 2))
    if config.motion.model != "control-points":
        return build_motion(config.motion.model, config)
    count = min(config.motion.nodes, len(points))
    moving = points[:0] if moves is None else points[moves]
    moving = moving[farthest_points(moving, min(count // 2, len(moving)))] if len(moving) else moving
    positions = torch.cat([moving, points[farthest_points(points, count - len(moving))]])
    radii = torch.full((len(positions),), float(neighbor_distance(positions).median()), device=points.device)
    if len(moving):  # those of a mover are closer together
        radii[: len(moving)] = float(neighbor_distance(moving).median())
    network = make_network(config.motion, heads_of(config.motion), config.seed)
    return ControlPoints(positions, radii, network, config.motion)


def control_points_from_spheres(gaussians: GaussianParameters, spheres: Spheres, config: TrainConfig) -> ControlPoints:
    """Make control points at the spheres' centres, all with the same initial radius.

    The radius is that of the spheres, but at least ``pretrain.least_radius`` times their typical spacing.
    """
    positions = gaussians.means.detach()
    spacing = float(neighbor_distance(positions).median())
    radius = max(float(spheres.log_radius.detach().exp()), config.pretrain.least_radius * spacing)
    radii = torch.full((len(positions),), radius, device=positions.device)
    return ControlPoints(positions, radii, spheres.network, config.motion)


def initial_gaussians(
    config: TrainConfig, points: Tensor, colors: Tensor, spheres: tuple[GaussianParameters, Spheres] | None = None
) -> GaussianParameters:
    """Make the Gaussians of the main stage at ``points`` [P, 3] with ``colors`` [P, 3], or around the spheres."""
    gaussians = _unstretched(config, points, colors, spheres)
    gaussians.hyper.data[:, : config.motion.hyper_dim] *= config.motion.hyper_stretch
    return gaussians


def _unstretched(
    config: TrainConfig, points: Tensor, colors: Tensor, spheres: tuple[GaussianParameters, Spheres] | None
) -> GaussianParameters:
    options: dict[str, Any] = {
        "sh_degree": config.sh_degree,
        "hyper_columns": config.motion.hyper_columns,
        "shaded": config.motion.has_shading,
        "corrected": config.motion.has_correctives,
        "sharpness": config.sharpness,
    }
    count = min(config.init_points, config.densify.max_gaussians)
    if spheres is None or config.init_from == "points":
        return gaussians_from_points(points[:count], colors[:count], **options)
    parents, motion = spheres
    with torch.no_grad():
        opaque = torch.where(parents.opacities() >= config.pretrain.solid_opacity)[0]
        opaque = opaque if len(opaque) else torch.arange(len(parents), device=opaque.device)
        random = generator(config.seed, Purpose.GAUSSIANS_OF_SPHERES)
        chosen = opaque[torch.randint(len(opaque), (count,), generator=random).to(opaque.device)]
        offsets = torch.randn(count, 3, generator=random).to(chosen.device) * motion.log_radius.exp()
        colors = (parents.sh_dc[chosen] * SH_C0 + 0.5).clamp(0.0, 1.0)
        gaussians = gaussians_from_points(parents.means[chosen] + offsets, colors, **options)
        if config.pretrain.silhouette > 0:  # Splats larger than a thin part would turn transparent before they shrink.
            torch.minimum(gaussians.log_scales, motion.log_radius, out=gaussians.log_scales.data)
        return gaussians
