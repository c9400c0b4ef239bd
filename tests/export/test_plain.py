"""Gaussians in place of sharp ones: they look alike, from every side and at every time."""

from __future__ import annotations

import copy
import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene
from helpers.export_files import ply_columns
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.apps import export as app
from scgs_warp.evaluation.image_metrics import psnr
from scgs_warp.export import plain
from scgs_warp.export.plain import plain_scene
from scgs_warp.geometry.cameras import Overview, orbit_camera
from scgs_warp.runtime import environment
from scgs_warp.scene.scene import Scene
from scgs_warp.training.loop import fit
from scgs_warp.types import plain_scale


def sharp_scene(longer_side: float = 64.0) -> Scene:
    scene = bar_scene(nodes=24, gaussians=400, shaded=True)
    scene.gaussians.sharpness = 0.5
    scene.config = dataclasses.replace(scene.config, sharpness=0.5)
    scene.overview = dataclasses.replace(scene.overview, longer_side=longer_side)
    return scene


def score(scene: Scene, truth: Scene, size: int = 64) -> float:
    """Worst PSNR over views and times that the fit has not seen."""
    return min(
        float(psnr(scene.render(camera, time).rgb, truth.render(camera, time).rgb))
        for time in (0.1, 0.9)
        for camera in (orbit_camera(scene.overview, azimuth, size) for azimuth in (10.0, 130.0, 250.0))
    )


def test_the_fit_is_closer_than_the_formula():
    scene = sharp_scene()
    before = {name: value.clone() for name, value in scene.tensors().items()}
    fitted = plain_scene(scene)
    formula = copy.copy(scene)
    formula.gaussians = copy.deepcopy(scene.gaussians)
    formula.gaussians.sharpness = 0.0
    with torch.no_grad():
        formula.gaussians.log_scales += math.log(plain_scale(0.5))
    assert fitted.gaussians.sharpness == fitted.config.sharpness == 0.0
    assert score(fitted, scene) > score(formula, scene) + 1.0
    assert all(torch.equal(value, before[name]) for name, value in scene.tensors().items())
    assert scene.gaussians.sharpness == 0.5


def test_same_scene_same_bits(all_threads):
    found = []
    for threads in (1, 2):
        environment.configure(threads)
        found.append(plain_scene(sharp_scene()).tensors())
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])


def test_a_scene_without_sharpness_stays_itself():
    scene = bar_scene()
    assert plain_scene(scene) is scene


def test_gaussians_that_are_broken_or_out_of_sight_get_the_formula():
    scene = sharp_scene()
    with torch.no_grad():
        scene.gaussians.means[0] = 1e25
        scene.gaussians.means[1] = float("nan")
    fitted = plain_scene(scene).gaussians
    expected = scene.gaussians.log_scales[:2] + math.log(plain_scale(0.5))
    assert torch.equal(fitted.log_scales[:2], expected)
    assert fitted.log_scales.isfinite().all() and fitted.opacity_logits.isfinite().all()


def test_views_cover_the_orbit_or_the_arc():
    ring = Overview((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 4.0, 40.0, 10.0, azimuth=30.0)
    found = sorted(plain.view_azimuth(ring, index) % 360.0 for index in range(plain.VIEWS))
    gaps = np.diff([*found, found[0] + 360.0])
    assert gaps.max() < 2.0 * 360.0 / plain.VIEWS
    arc = dataclasses.replace(ring, sweep=50.0)
    found = [plain.view_azimuth(arc, index) for index in range(plain.VIEWS)]
    assert min(found) >= 10.0 and max(found) <= 50.0 and max(found) - min(found) > 35.0


@pytest.mark.parametrize("arguments", [("a.ply",), ("a.ply", "--time", "0.5"), ("a.npz",)])
def test_exports_hold_the_fit(tmp_path, arguments):
    run = tmp_path / "run"
    fit(tiny_config(40), tiny_dataset(3), output=run)
    path = Path(tmp_path / arguments[0])
    command = ["--run", str(run), "--output", str(path), *arguments[1:], "--device", "cpu"]
    assert app.cli(command) == 0
    scene = plain_scene(Scene.load(run))
    assert scene.overview.longer_side == 48.0
    expected = scene.gaussians_at(0.5).scales
    if path.suffix == ".npz":
        found = np.load(path)["scales"]
    else:
        columns = ply_columns(path)
        found = np.exp(np.stack([columns[f"scale_{axis}"] for axis in range(3)], axis=1))
    np.testing.assert_allclose(found, expected, rtol=2e-5)
