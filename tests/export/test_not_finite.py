"""Exports of scenes with numbers that are not finite: such Gaussians are left out, such motions refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

from helpers.edit_scenes import bar_scene
from helpers.export_files import gltf_arrays
from helpers.page_reader import read_page
from scgs_warp.errors import UserError
from scgs_warp.export import run as job
from scgs_warp.export.request import ExportRequest, Format
from scgs_warp.motion.control_points import ControlPoints
from scgs_warp.scene.scene import Scene
from scgs_warp.types import Pose


@pytest.fixture
def scene() -> Scene:
    return bar_scene(nodes=12, gaussians=50, shaded=True, share=0.8)


def spoil(scene: Scene) -> None:
    """Two Gaussians whose shading and hyper-coordinates are no numbers."""
    with torch.no_grad():
        scene.gaussians.shading[3, 2] = float("nan")
        scene.gaussians.hyper[7, -1] = float("inf")


def spoil_motion(scene: Scene) -> None:
    assert isinstance(scene.motion, ControlPoints)
    plain = scene.motion.poses

    def poses(times: torch.Tensor) -> list[Pose]:
        found = plain(times)
        for time, pose in zip(times.tolist(), found):
            if time > 0.9:
                pose.translations[4] = float("nan")
        return found

    scene.motion.poses = poses  # type: ignore[method-assign]


def write(scene: Scene, path: Path, kind: Format, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job, "_open", lambda *_: scene)
    monkeypatch.setattr(Scene, "load", lambda *_, **__: scene)
    job.export(ExportRequest(path, run=Path("runs/x"), format=kind, frames=None if kind == "html" else 3))


def test_npz_leaves_out_gaussians_that_are_not_finite(scene, tmp_path, monkeypatch):
    spoil(scene)
    write(scene, tmp_path / "a.npz", "npz", monkeypatch)
    found = dict(np.load(tmp_path / "a.npz"))
    assert found["shading"].shape == (48, 10)
    assert all(np.isfinite(values).all() for values in found.values() if values.dtype.kind == "f")


def test_glb_leaves_out_gaussians_that_are_not_finite(scene, tmp_path, monkeypatch):
    spoil(scene)
    write(scene, tmp_path / "a.glb", "glb", monkeypatch)
    for name, values in gltf_arrays(tmp_path / "a.glb")[0].items():
        assert len(values) == 48 and np.isfinite(values).all(), name


def test_sequences_leave_out_gaussians_that_are_not_finite(scene, tmp_path, monkeypatch):
    spoil(scene)
    with torch.no_grad():
        scene.gaussians.sh_dc[5, 1] = float("nan")
    write(scene, tmp_path / "frames", "ply-sequence", monkeypatch)
    for path in sorted((tmp_path / "frames").iterdir()):
        data = PlyData.read(str(path))["vertex"].data
        assert len(data) == 47 and all(np.isfinite(data[name]).all() for name in data.dtype.names)


def test_pages_leave_out_gaussians_that_are_not_finite(scene, tmp_path, monkeypatch):
    spoil(scene)
    write(scene, tmp_path / "a.html", "html", monkeypatch)
    facts, columns = read_page(tmp_path / "a.html")
    assert facts["gaussians"] == 48 and all(np.isfinite(values).all() for values in columns.values())


@pytest.mark.parametrize(("name", "kind"), [("a.glb", "glb"), ("a.glb", "graph"), ("a.npz", "npz"), ("a.html", "html")])
def test_a_motion_that_is_not_finite_is_one_line(scene, tmp_path, monkeypatch, name, kind):
    spoil_motion(scene)
    with pytest.raises(UserError, match=r"motion is not finite.*; train again") as caught:
        write(scene, tmp_path / name, kind, monkeypatch)
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())
