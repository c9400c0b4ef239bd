"""Static scenes with control points, made from files of Gaussians or from static scenes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..config.presets import preset
from ..formats.gaussian_files import read_antialiased, read_gaussians, shortage_as_user_error
from ..gaussians import GaussianParameters
from ..geometry.axes import Axis, direction
from ..geometry.cameras import Overview
from ..geometry.normalisation import COMMON_RADIUS, Normalisation
from ..motion.static_nodes import COUNT, StaticNodes
from ..runtime.environment import check_device
from .scene import Scene

FOV_AND_ELEVATION = (40.0, 10.0)
"""Field of view and elevation, degrees, of the overview, since files of Gaussians have no cameras."""
BULK_QUANTILES = (0.02, 0.98)
"""Quantiles of the opaque Gaussians' coordinates that bound the scene."""
MIN_OPACITY = 0.1


def open_gaussians(
    path: str | Path, device: str = "cpu", nodes: int = COUNT, up: Axis | tuple[float, float, float] | None = None
) -> Scene:
    """Open a file of Gaussians (``gaussian_files.READERS``) as a static scene with control points.

    Args:
        nodes: number of control points, sampled from the Gaussians.
        up: up direction of the overview, or its axis; None: -y, the convention of structure from motion.

    Raises:
        UserError: as :func:`~scgs_warp.formats.gaussian_files.read_gaussians`, or there is no such device.
    """
    check_device(device)
    gaussians = read_gaussians(path)
    with shortage_as_user_error(Path(path)):
        towards = direction(up) if isinstance(up, str) else up
        return _static_scene(Path(path), gaussians, device, nodes, towards)


def _static_scene(
    path: Path, gaussians: GaussianParameters, device: str, nodes: int, up: tuple[float, float, float] | None
) -> Scene:
    world = gaussians.means.detach().double().numpy()
    solid = world[(gaussians.opacities() > MIN_OPACITY).numpy()]
    low, high = np.quantile(solid if len(solid) else world, BULK_QUANTILES, axis=0)
    centre = (low + high) / 2
    radius = float(np.linalg.norm(high - low)) / 2
    unit = Normalisation(centre, COMMON_RADIUS / radius if radius > 0 else 1.0)
    with torch.no_grad():
        gaussians.means.copy_(unit.apply(gaussians.means))
        gaussians.log_scales.add_(math.log(unit.scale))
    gaussians = gaussians.to(device)
    fov, elevation = FOV_AND_ELEVATION
    distance = 1.2 * max(radius, 1e-9) / math.tan(math.radians(fov) / 2)
    x, y, z = centre.tolist()
    overview = Overview((x, y, z), up or (0.0, -1.0, 0.0), distance, fov, elevation)
    config = replace(preset("best"), antialiased=read_antialiased(path), sharpness=gaussians.sharpness)
    scene = Scene(gaussians, StaticNodes.sample(gaussians, nodes), unit, config, overview)
    scene.motion.eval()
    return scene


def with_control_points(scene: Scene, nodes: int = COUNT) -> Scene:
    """Return a static scene with control points in place of its motion."""
    motion = StaticNodes.sample(scene.gaussians, nodes)
    made = Scene(
        scene.gaussians, motion, scene.normalisation, scene.config, scene.overview, step=scene.step,
        settings=scene.settings,
    )  # fmt: skip
    made.folder = scene.folder
    return made
