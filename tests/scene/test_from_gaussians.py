"""Files of Gaussians as static scenes: which way is up."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch

from helpers.app_runs import run_app
from helpers.edit_scenes import bar_scene
from helpers.export_files import cloud
from scgs_warp.export.request import ExportRequest
from scgs_warp.export.run import export
from scgs_warp.export.still import write_still
from scgs_warp.geometry.axes import Axis, direction
from scgs_warp.geometry.cameras import orbit_camera
from scgs_warp.scene.from_gaussians import open_gaussians, with_control_points


def column(folder: Path, axis: Axis) -> Path:
    """Write a file of opaque Gaussians that stand along an axis, the upper half red."""
    all_of_them = cloud()
    count = len(all_of_them.means)
    heights = torch.linspace(-1, 1, count)
    path = folder / "column.ply"
    red = torch.zeros(count, 3)
    red[heights > 0, 0] = 1.5
    write_still(
        path,
        replace(
            all_of_them,
            means=heights[:, None] * torch.tensor(direction(axis)),
            scales=torch.full((count, 3), 0.05),
            opacities=torch.full((count,), 0.95),
            sh_dc=red.reshape(all_of_them.sh_dc.shape),
            sh_rest=torch.zeros_like(all_of_them.sh_rest),
        ),
    )
    return path


@pytest.mark.parametrize("axis", get_args(Axis))
def test_the_axis_that_is_named_points_up(tmp_path, axis):
    scene = open_gaussians(column(tmp_path, axis), nodes=20, up=axis)
    image = scene.render(orbit_camera(scene.overview, 30.0, 64), 0.0)
    rows, columns = np.nonzero(image.alpha.numpy() > 0.3)
    assert np.ptp(rows) > 3 * np.ptp(columns)
    assert image.rgb[: rows.min() + 8, :, 0].max() > image.rgb[rows.max() - 8 :, :, 0].max() + 0.2


def test_minus_y_is_up_unless_told(tmp_path):
    path = column(tmp_path, "-y")
    assert open_gaussians(path, nodes=20).overview == open_gaussians(path, nodes=20, up="-y").overview
    assert open_gaussians(path, nodes=20).overview != open_gaussians(path, nodes=20, up="z").overview


def test_gltf_stands_upright(tmp_path):
    path = column(tmp_path, "z")
    export(ExportRequest(output=tmp_path / "a.glb", ply=path, up="z"))
    export(ExportRequest(output=tmp_path / "b.glb", ply=path))
    trimesh = pytest.importorskip("trimesh")
    upright, lying = (
        np.concatenate([item.vertices for item in trimesh.load(tmp_path / name).dump()]) for name in ("a.glb", "b.glb")
    )
    assert np.ptp(upright[:, 1]) > 1.9 and np.ptp(lying[:, 1]) < 0.1


@pytest.mark.parametrize("app", ["view", "edit", "export"])
def test_a_run_knows_what_is_up(tmp_path, app):
    output = tmp_path / ("a.ply" if app == "export" else "a.gif")
    done = run_app(app, "--run", str(tmp_path), "--up", "z", "--output", str(output))
    assert done.returncode == 2 and "--up z: belongs to --ply" in done.stderr


@pytest.mark.parametrize("moves", [False, True])
def test_posed_gaussians_need_no_gradients(moves):
    scene = bar_scene()
    gaussians = (scene if moves else with_control_points(scene)).gaussians_at(0.3)
    for field in dataclasses.fields(gaussians):
        value = getattr(gaussians, field.name)
        assert not (isinstance(value, torch.Tensor) and value.requires_grad), field.name
