"""Files of Gaussians in any format: opened as scenes and points, refused in one line, complete or not at all."""

from __future__ import annotations

import dataclasses
import gzip
import os
import struct
from pathlib import Path

import numpy as np
import pytest

from helpers.export_files import cloud, nearest, ordered, zeros_spz
from scgs_warp.apps.cli import run
from scgs_warp.data.points import read_points
from scgs_warp.errors import UserError
from scgs_warp.export import run as job
from scgs_warp.export.request import ExportRequest
from scgs_warp.export.still import write_still
from scgs_warp.formats import gaussian_files
from scgs_warp.formats.gaussian_files import gaussian_points, read_antialiased, read_gaussians
from scgs_warp.gaussians import SH_C0, GaussianParameters
from scgs_warp.motion.static_nodes import StaticNodes
from scgs_warp.scene.from_gaussians import open_gaussians


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".splat", ".spz", ".sog"])
def test_files_open_as_scenes_and_as_points(tmp_path, suffix):
    truth = ordered(cloud())
    path = tmp_path / f"a{suffix}"
    write_still(path, truth)
    scene = open_gaussians(path, nodes=20)
    step = {".compressed.ply": 2e-3, ".sog": 1e-4}.get(suffix, 2e-5)
    places = scene.gaussians_at(0.0).means.detach().double().numpy()
    np.testing.assert_allclose(places[nearest(places, truth)], truth.means.double().numpy(), atol=step)
    assert scene.control_point_count == 20
    for points, colors in (gaussian_points(path), read_points(path)):
        assert colors is not None
        order = nearest(points, truth)
        np.testing.assert_allclose(points[order], truth.means.double().numpy(), atol=step)
        expected = (0.5 + SH_C0 * truth.sh_dc.double().numpy()).clip(0, 1)
        np.testing.assert_allclose(colors[order], expected, atol=0.02 if suffix == ".sog" else 0.005)


def test_damaged_files_are_one_line(tmp_path):
    write_still(tmp_path / "a.spz", cloud(), spz_version=3)
    good = (tmp_path / "a.spz").read_bytes()
    plain = gzip.decompress(good)
    files = {
        "cut.spz": (good[:-400], "cut short"),
        "sum.spz": (good[:-8] + bytes([good[-8] ^ 1]) + good[-7:], "check sum"),
        "trailer.spz": (good[:-1], "cut short"),
        "text.spz": (b"hello world, no Gaussians here", "neither"),
        "other.spz": (gzip.compress(b"x" * 100), "something else"),
        "empty.spz": (b"", "neither"),
        "new.spz": (gzip.compress(plain[:4] + b"\x09" + plain[5:]), "version 9"),
        "many.spz": (gzip.compress(plain[:8] + b"\xff\xff\xff\x7f" + plain[12:]), "up to 10,000,000"),
        "some.spz": (gzip.compress(plain[:8] + struct.pack("<I", 301) + plain[12:]), "cut short"),
        "bomb.spz": (gzip.compress(plain[:8] + struct.pack("<I", 10**7) + plain[12:]), "cannot hold"),
        "stream.spz": (b"NGSP" + struct.pack("<IIBBBBI", 4, 9, 0, 12, 0, 5, 32) + bytes(92), "damaged"),
        "odd.splat": (b"1" * 33, "multiple of 32"),
        "empty.splat": (b"", "multiple of 32"),
        "nan.splat": (np.full(8, np.nan, "<f4").tobytes(), "finite"),
        "a.obj": (b"v 0 0 0", ".splat"),
    }
    for name, (content, words) in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=words) as caught:
            read_gaussians(tmp_path / name)
        assert name in str(caught.value) and "\n" not in str(caught.value)
    for name in ("missing.spz", "missing.splat", "missing.ply"):
        with pytest.raises(UserError, match="no such file"):
            read_gaussians(tmp_path / name)


def test_nothing_is_lost_when_the_disk_refuses(tmp_path, monkeypatch):
    path = tmp_path / "a.glb"
    write_still(path, cloud())
    before = path.read_bytes()
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(UserError, match="No space"):
        write_still(path, cloud(degree=0))
    assert path.read_bytes() == before and sorted(p.name for p in tmp_path.iterdir()) == ["a.glb"]
    with pytest.raises(UserError, match=r"\.spz"):
        write_still(tmp_path / "a.obj", cloud())


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
        job.export(ExportRequest(tmp_path / "b.ply", ply=path))
    assert run(refuse) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "b.ply").exists()
    with pytest.raises(RuntimeError, match="another"):
        run(lambda _: (_ for _ in ()).throw(RuntimeError("another")))


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz"])
def test_the_mark_of_antialiasing_is_kept(tmp_path, suffix, antialiased):
    write_still(tmp_path / f"a{suffix}", cloud(), antialiased=antialiased)
    assert read_antialiased(tmp_path / f"a{suffix}") == antialiased
    assert open_gaussians(tmp_path / f"a{suffix}", nodes=5).config.antialiased == antialiased
    job.export(ExportRequest(tmp_path / f"b{suffix}", ply=tmp_path / f"a{suffix}"))
    assert read_antialiased(tmp_path / f"b{suffix}") == antialiased
    assert not read_antialiased(tmp_path / f"missing{suffix}") and not read_antialiased(tmp_path)
    os.mkfifo(tmp_path / f"pipe{suffix}")  # nobody writes to it
    assert not read_antialiased(tmp_path / f"pipe{suffix}")


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".splat", ".spz", ".sog", ".glb"])
def test_sharp_gaussians_are_written_as_the_most_similar_ones(tmp_path, suffix):
    gaussians = cloud()
    sharp = dataclasses.replace(gaussians, sharpness=0.5)
    written = []
    for index, value in enumerate((sharp, sharp.plain(), gaussians)):
        path = tmp_path / f"{index}{suffix}"
        write_still(path, value)
        written.append(path.read_bytes())
    assert written[0] == written[1] != written[2]
