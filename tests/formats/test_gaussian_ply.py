"""3D-GS files: names and order of its reference implementation, there and back, and files that are none."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from plyfile import PlyData, PlyElement

from helpers.edit_scenes import dress
from helpers.export_files import cloud, difference, ordered, picture, ply_columns
from helpers.node_packages import splat_transform
from scgs_warp.apps import export as app
from scgs_warp.edit import EditSession
from scgs_warp.edit.rotations import from_axis
from scgs_warp.errors import UserError
from scgs_warp.export.still import write_still
from scgs_warp.formats.gaussian_files import read_antialiased, read_gaussians
from scgs_warp.formats.gaussian_ply import OPAQUE_LOGIT, read_gaussian_ply, write_gaussian_ply
from scgs_warp.geometry import cameras
from scgs_warp.scene.from_gaussians import open_gaussians


def make(tmp_path: Path, degree: int = 3, count: int = 300) -> Path:
    generator = torch.Generator().manual_seed(degree)
    made = dress(torch.randn(count, 3, generator=generator) * torch.tensor([5.0, 1.0, 1.0]) + 20.0, degree=degree)
    path = tmp_path / f"scene{degree}.ply"
    write_gaussian_ply(path, made.activate())
    return path


@pytest.mark.parametrize("degree", range(4))
def test_there_and_back(tmp_path, degree):
    path = make(tmp_path, degree)
    data = PlyData.read(str(path))["vertex"].data
    rest = 3 * ((degree + 1) ** 2 - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest)),
             "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    assert list(data.dtype.names) == names and len(data) == 300
    found = read_gaussian_ply(path)
    generator = torch.Generator().manual_seed(degree)
    made = dress(torch.randn(300, 3, generator=generator) * torch.tensor([5.0, 1.0, 1.0]) + 20.0, degree=degree)
    assert torch.equal(found.means, made.means) and torch.equal(found.sh_dc, made.sh_dc)
    assert torch.equal(found.sh_rest, made.sh_rest)
    torch.testing.assert_close(found.log_scales, made.log_scales)
    torch.testing.assert_close(found.opacity_logits, made.opacity_logits, rtol=1e-5, atol=1e-5)
    if degree:  # channel by channel: f_rest_0 .. are all of red
        np.testing.assert_array_equal(data["f_rest_1"], made.sh_rest[:, 1, 0].detach().numpy())
    again = tmp_path / "again.ply"
    write_gaussian_ply(again, found.activate())
    assert again.stat().st_size == path.stat().st_size


def test_infinite_logits_are_opaque_or_clear(tmp_path):
    """Some programs write them for an opacity of 1 or 0; the Gaussians stay, and the others' values do not change."""
    path = make(tmp_path, 0, 5)
    expected = read_gaussian_ply(path).opacity_logits.detach().clone()
    file = PlyData.read(str(path), mmap=False)
    file["vertex"].data["opacity"][1], file["vertex"].data["opacity"][3] = np.inf, -np.inf
    file.write(str(tmp_path / "infinite.ply"))
    found = read_gaussian_ply(tmp_path / "infinite.ply")
    assert len(found) == 5 and found.opacities().tolist()[1::2] == [1.0, pytest.approx(0.0, abs=1e-30)]
    expected[1], expected[3] = OPAQUE_LOGIT, -OPAQUE_LOGIT
    assert torch.equal(found.opacity_logits, expected)


def test_flat_gaussians_are_kept_and_those_left_out_are_counted(tmp_path, capsys):
    """Programs that store a thickness of 0 write the logarithm -inf."""
    path = tmp_path / "flat.ply"
    data = PlyData.read(str(make(tmp_path, 0, 6)), mmap=False)
    data["vertex"].data["scale_2"][:3] = -np.inf
    data["vertex"].data["scale_0"][5] = np.nan
    data.write(str(path))
    found = read_gaussian_ply(path)
    assert len(found) == 5 and found.left_out == 1
    assert (found.activate().scales[:3, 2] < 1e-29).all() and found.activate().scales.isfinite().all()
    assert app.cli(["--ply", str(path), "--output", str(tmp_path / "flat.splat"), "--device", "cpu"]) == 0
    assert "5 Gaussians as in" in (out := capsys.readouterr().out) and "without 1 that cannot be drawn" in out


def test_a_file_is_edited_and_exported(tmp_path):
    scene = open_gaussians(make(tmp_path), nodes=40)
    session = EditSession(scene)
    assert len(session) == 40
    before = scene.gaussians_at(0.0)
    torch.testing.assert_close(before.means, read_gaussian_ply(tmp_path / "scene3.ply").means, rtol=1e-6, atol=1e-5)
    x = session.node_positions(0.0)[:, 0]
    session.add_handle(np.flatnonzero(x > np.quantile(x, 0.8)), 0.0, "end")
    session.pin(np.flatnonzero(x < np.quantile(x, 0.5)))
    session.move("end", [0, 0, 3.0], from_axis([0, 1, 0], 60))
    session.export_ply(tmp_path / "edited.ply", 0.0)
    found = read_gaussian_ply(tmp_path / "edited.ply").activate()
    torch.testing.assert_close(found.means, session.gaussians_at(0.0).means)
    torch.testing.assert_close(found.sh_rest, session.gaussians_at(0.0).sh_rest)
    assert float((found.means - before.means).norm(dim=1).max()) > 1.0
    image = session.render(cameras.orbit_camera(scene.overview, 0.0, 64), 0.0)
    assert float(image.alpha.max()) > 0.5


def test_an_edited_file_keeps_the_mark_of_antialiasing(tmp_path):
    scene = open_gaussians(make(tmp_path), nodes=40)
    for antialiased in (True, False):
        scene.config = dataclasses.replace(scene.config, antialiased=antialiased)
        EditSession(scene).export_ply(tmp_path / "edited.ply", 0.0)
        assert read_antialiased(tmp_path / "edited.ply") is antialiased


def test_the_public_example_opens_bends_and_exports(tmp_path, data_root):
    scene = open_gaussians(data_root / "splats" / "tiny_3dgs_9080.ply", nodes=300)
    assert scene.gaussian_count == 9080 and scene.gaussians.sh_degree == 3
    session = EditSession(scene)
    session.add_handle(session.ring([0], 1), 0.0, "a")
    session.pin_rest(2)
    session.move("a", [30.0, 0, 0])
    session.export_ply(tmp_path / "out.ply", 0.0)
    assert len(read_gaussian_ply(tmp_path / "out.ply")) == 9080


def vertices(tmp_path: Path, **changes) -> Path:
    """A good file with columns replaced, or removed (None)."""
    data = PlyData.read(str(make(tmp_path, 1, 20)))["vertex"].data
    columns = {name: changes.get(name, data[name]) for name in data.dtype.names}
    columns |= {name: value for name, value in changes.items() if name not in columns}
    columns = {name: np.asarray(value) for name, value in columns.items() if value is not None}
    table = np.empty(20, dtype=[(name, "f4") for name in columns])
    for name, value in columns.items():
        table[name] = value
    path = tmp_path / "changed.ply"
    PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    return path


def test_bad_files_are_one_line(tmp_path):
    (tmp_path / "no.ply").write_bytes(b"ply\nformat ascii 1.0\nend")
    (tmp_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
    )
    (tmp_path / "empty.ply").write_bytes(b"")
    many = b"ply\nformat binary_little_endian 1.0\nelement vertex 100000000000000000000\nproperty float x\nend_header\n"
    (tmp_path / "many.ply").write_bytes(many)
    cut = make(tmp_path, 2)
    cut.write_bytes(cut.read_bytes()[:-100])
    cases = [
        (tmp_path / "missing.ply", "no such file"),
        (tmp_path / "no.ply", "no PLY"),
        (tmp_path / "empty.ply", "no PLY"),
        (tmp_path / "many.ply", "no PLY"),
        (cut, "no PLY"),
        (tmp_path / "points.ply", "lack opacity"),
        (vertices(tmp_path, f_rest_8=None), "f_rest"),
    ]
    for path, words in cases:
        with pytest.raises(UserError, match=words) as caught:
            read_gaussian_ply(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(UserError, match="finite"):
        read_gaussian_ply(vertices(tmp_path, x=np.full(20, np.nan)))
    with pytest.raises(UserError, match=r"\.ply"):
        write_gaussian_ply(tmp_path / "out.txt", dress(torch.rand(3, 3)).activate())


def test_gaussians_that_are_not_finite_are_left_out(tmp_path):
    broken = np.zeros(20)
    broken[3] = np.inf
    assert len(read_gaussian_ply(vertices(tmp_path, scale_1=broken))) == 19


@pytest.mark.parametrize("count", [1, 2, 5])
def test_tiny_files_open(tmp_path, count):
    scene = open_gaussians(make(tmp_path, 0, count))
    session = EditSession(scene)
    assert len(session) == count
    session.add_handle([0], 0.0, "a")
    session.move("a", [1.0, 0, 0])
    assert torch.isfinite(session.gaussians_at(0.0).means).all()


def test_a_header_that_counts_more_than_there_is(tmp_path):
    """Of any element: room for it is made before it is read."""
    path = tmp_path / "scene.ply"
    head = [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 1",
        "property float x",
        "element other 1000000000",
    ]
    path.write_bytes("\n".join([*head, "property list uint float y", "end_header", ""]).encode() + bytes(12))
    with pytest.raises(UserError, match="no PLY file with vertices"):
        read_gaussian_ply(path)


def test_ply_is_read_by_plyfile_trimesh_and_splat_transform(tmp_path):
    truth = ordered(cloud())
    write_still(tmp_path / "a.ply", truth)
    assert max(difference(ply_columns(tmp_path / "a.ply"), truth).values()) < 2e-5
    loaded = trimesh.load(tmp_path / "a.ply")
    np.testing.assert_array_equal(loaded.vertices, truth.means.double().numpy())
    assert float((picture(read_gaussians(tmp_path / "a.ply").activate()) - picture(truth)).abs().max()) < 1e-5
    other = splat_transform(tmp_path / "a.ply", tmp_path / "b.ply")
    assert max(difference(ply_columns(other), truth).values()) < 2e-5
