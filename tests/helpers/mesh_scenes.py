"""Scenes whose surface is known: balls of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from helpers.edit_scenes import OVERVIEW
from scgs_warp.config.presets import preset
from scgs_warp.gaussians import SH_C0, GaussianParameters, gaussians_from_points
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.motion.static_nodes import StaticNodes
from scgs_warp.scene.scene import Scene

THICKNESS = 0.002
"""Standard deviation of the Gaussians across the surface, relative to the radius."""


def ball_gaussians(
    balls: Sequence[tuple[tuple[float, float, float], float]] = (((0.0, 0.0, 0.0), 0.5),), count: int = 1200
) -> GaussianParameters:
    """Flat, opaque Gaussians on the surfaces of balls (centre, radius): red above each centre, blue below."""
    index = np.arange(count)
    z = 1.0 - 2.0 * (index + 0.5) / count
    turn = math.pi * (1.0 + 5.0**0.5) * index
    unit = np.column_stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    points = np.concatenate([np.array(centre) + radius * unit for centre, radius in balls])
    radii = np.repeat([radius for _, radius in balls], count)
    normals = np.tile(unit, (len(balls), 1))
    colors = np.where(normals[:, 2:] > 0, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    places, shades = torch.from_numpy(points).float(), torch.from_numpy(colors).float()
    made = gaussians_from_points(places, shades, sh_degree=0, hyper_columns=0)
    half = np.arccos(np.clip(normals[:, 2], -1, 1)) / 2  # turns z to the normal
    axis = np.column_stack([-normals[:, 1], normals[:, 0], np.zeros(len(normals))])
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-12)
    spacing = radii * math.sqrt(4 * math.pi / count)
    with torch.no_grad():
        made.quats.copy_(torch.from_numpy(np.column_stack([np.cos(half), np.sin(half)[:, None] * axis])))
        scales = np.column_stack([0.8 * spacing, 0.8 * spacing, THICKNESS * radii])
        made.log_scales.copy_(torch.from_numpy(np.log(scales)))
        made.opacity_logits.fill_(4.0)
        made.sh_dc.copy_(torch.from_numpy((colors - 0.5) / SH_C0))
    return made


def still_scene(gaussians: GaussianParameters, scale: float = 1.0) -> Scene:
    """A static scene with units of its own."""
    unit = Normalisation(np.array([0.2, -0.1, 0.3]), scale)
    with torch.no_grad():
        gaussians.means.copy_(unit.apply(gaussians.means))
        gaussians.log_scales.add_(math.log(scale))
    scene = Scene(gaussians, StaticNodes.sample(gaussians, 20), unit, preset("best"), OVERVIEW)
    scene.config = type(scene.config)(**{**vars(scene.config), "sharpness": 0.0})
    scene.motion.eval()
    return scene
