"""What must not go wrong quietly: files that claim too much, numbers that are not finite, disks that refuse."""

from __future__ import annotations

import gzip
import os
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

from helpers.edit_scenes import bar_scene
from helpers.export_files import gltf_arrays
from helpers.page_reader import read_page
from scgs_warp.apps.cli import run
from scgs_warp.errors import UserError
from scgs_warp.export import run as job
from scgs_warp.export.gltf import Document
from scgs_warp.export.request import Format, Request
from scgs_warp.export.sequence import write_sequence
from scgs_warp.export.skeleton import at_rest
from scgs_warp.formats import gaussian_files
from scgs_warp.gaussians import GaussianParameters
from scgs_warp.motion.control_points import ControlPoints
from scgs_warp.motion.static_nodes import StaticNodes
from scgs_warp.scene.from_gaussians import open_gaussians
from scgs_warp.scene.scene import Scene
from scgs_warp.types import Gaussians, Pose


def zeros_spz(path: Path, count: int) -> Path:
    """A file of harmonics of degree 3 that are all the same: a thousandth of what it holds."""
    head = struct.pack("<IIIBBBB", 0x5053474E, 3, count, 3, 12, 0, 0)
    path.write_bytes(gzip.compress(head + bytes(65 * count)))
    return path


def test_reading_spz_takes_a_few_times_what_it_holds(tmp_path):
    count = 50_000
    path = zeros_spz(tmp_path / "a.spz", count)
    tracemalloc.start()
    try:
        found = gaussian_files.read_gaussians(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(found.means) == count
    assert 65 * count < peak < 600 * count  # 59 numbers of 4 bytes, the file's bytes, masks


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")])
def test_what_does_not_fit_into_memory_is_one_line(tmp_path, monkeypatch, error):
    def refuse(path: Path) -> None:
        raise error

    monkeypatch.setitem(gaussian_files.READERS, ".spz", refuse)
    with pytest.raises(UserError, match=r"a\.spz: .*fit into memory; export"):
        gaussian_files.read_gaussians(tmp_path / "a.spz")


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")])
def test_what_does_not_fit_after_reading_is_one_line_too(tmp_path, monkeypatch, error, capsys):
    """The file fits, but nothing beside it."""

    def refuse(*_: object) -> None:
        raise error

    path = zeros_spz(tmp_path / "a.spz", 100)
    with monkeypatch.context() as patch:
        patch.setattr(StaticNodes, "sample", refuse)
        with pytest.raises(UserError, match=r"a\.spz: .*fit into memory; export"):
            open_gaussians(path)
    monkeypatch.setattr(GaussianParameters, "activate", refuse)
    with pytest.raises(UserError, match=r"a\.spz: .*fit into memory; export"):
        job.export(Request(tmp_path / "b.ply", ply=path))
    assert run(refuse) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "b.ply").exists()
    with pytest.raises(RuntimeError, match="another"):
        run(lambda _: (_ for _ in ()).throw(RuntimeError("another")))


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
    job.export(Request(path, run=Path("runs/x"), format=kind, frames=None if kind == "html" else 3))


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


def test_glb_is_never_json_that_is_not_json():
    document = Document()
    document.append("nodes", {"translation": [0.0, float("nan"), 0.0]})
    with pytest.raises(UserError, match="not finite"):
        document.content()


def frames(count: int) -> list[Gaussians]:
    return [at_rest(bar_scene(nodes=4, gaussians=5)) for _ in range(count)]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_an_earlier_sequence_outlives_a_failed_one(tmp_path, monkeypatch):
    folder = tmp_path / "frames"
    write_sequence(folder, frames(2))
    plain, calls = os.replace, []

    def refuse(source: Path, target: Path) -> None:
        calls.append(Path(source).suffix)
        if Path(source).suffix == ".part":
            raise OSError(5, "Input/output error")
        plain(source, target)

    monkeypatch.setattr("os.replace", refuse)
    with pytest.raises(UserError, match=r"frames: cannot be written \(Input/output error\)"):
        write_sequence(folder, frames(3))
    assert ".part" in calls and names(folder) == ["frame_00000.ply", "frame_00001.ply"]
    assert names(tmp_path) == ["frames"]


def test_sequences_follow_links_and_leave_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    for count in (3, 2):
        write_sequence(tmp_path / "link", frames(count))
        assert (tmp_path / "link").is_symlink() and len(names(tmp_path / "real")) == count
    (tmp_path / "here" / "below").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here" / "below")
    for name in (".", "..", str(tmp_path / "here" / "below"), "/"):
        with pytest.raises(UserError, match=r"current folder .*; name a new folder"):
            write_sequence(Path(name), frames(1))
    assert names(tmp_path) == ["here", "link", "real"]
