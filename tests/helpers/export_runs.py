"""Runs to export, written without training."""

from __future__ import annotations

import json
from pathlib import Path

import torch

from helpers.edit_scenes import bar_scene
from scgs_warp.apps import export as app
from scgs_warp.config.presets import from_dict
from scgs_warp.motion import Static, build_motion
from scgs_warp.motion.control_points import ControlPoints
from scgs_warp.scene.scene import Scene
from scgs_warp.storage import checkpoint


def save(scene: Scene, folder: Path) -> Path:
    """A run folder that ``Scene.load`` reads; the network is what it is."""
    folder.mkdir()
    checkpoint.write(folder, scene.tensors(), {**scene.metadata(), "stage": "main"})
    (folder / "config.json").write_text(json.dumps(scene.settings))
    return folder


def moving_run(folder: Path, masked: bool = False, swing: float = 0.3) -> Path:
    """Write a run whose network moves things a little, with shading and correctives.

    Args:
        swing: size of the network's random weights; at 0.02 the body holds together, and its parts hang on each other.
    """
    like = bar_scene(nodes=24, gaussians=120, shaded=True, corrected=True, share=0.5 if masked else None)
    fields = {"nodes": 24, "layers": 3, "width": 32, "skip": 2, "mask": masked}
    config = from_dict({"motion": fields, "sharpness": 0.0})
    template = build_motion("control-points", config)
    assert isinstance(template, ControlPoints)
    rig = like.motion
    assert isinstance(rig, ControlPoints)
    motion = ControlPoints(rig.positions.detach(), rig.log_radii.detach().exp(), template.network, config.motion)
    torch.manual_seed(0)
    with torch.no_grad():
        for parameter in motion.network.parameters():
            parameter.copy_(swing * torch.randn_like(parameter))
    if masked:
        with torch.no_grad():
            like.gaussians.hyper[:, -1] = torch.linspace(-60.0, 8.0, len(like.gaussians.hyper))
    scene = Scene(like.gaussians, motion, like.normalisation, config, like.overview)
    return save(scene, folder)


def still_scene() -> Scene:
    scene = bar_scene(nodes=8, gaussians=20)
    return Scene(scene.gaussians, Static(), scene.normalisation, scene.config, scene.overview)


def export(*arguments: object) -> None:
    assert app.cli([*map(str, arguments), "--device", "cpu"]) == 0
