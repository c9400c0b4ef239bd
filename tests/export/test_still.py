"""Gaussians at one instant: written, opened by programs of others, read back."""

from __future__ import annotations

import gzip
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from plyfile import PlyData

from helpers.edit_scenes import dress
from helpers.export_files import gltf_arrays, picture
from helpers.node_packages import gltf_errors, splat_transform
from scgs_warp.data.points import read_points
from scgs_warp.edit.rotations import rotate
from scgs_warp.errors import UserError
from scgs_warp.export.gltf import upright
from scgs_warp.export.request import Request
from scgs_warp.export.run import export, write_still
from scgs_warp.formats.gaussian_files import gaussian_points, read_gaussians
from scgs_warp.formats.gaussian_spz import FLIPS, fraction_bits, pack_quats, read_antialiased, unpack_quats
from scgs_warp.gaussians import SH_C0
from scgs_warp.ops.harmonics_rotation import rotate_harmonics
from scgs_warp.scene.from_gaussians import open_gaussians
from scgs_warp.types import Gaussians

UPS = [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, -0.8)]


@torch.no_grad()
def cloud(count: int = 300, degree: int = 3) -> Gaussians:
    generator = torch.Generator().manual_seed(5)
    made = dress(0.5 * torch.randn(count, 3, generator=generator) + torch.tensor([0.3, -0.2, 0.1]), degree=degree)
    made.opacity_logits.copy_(2.0 * torch.randn(count, generator=generator))
    made.log_scales.add_(0.4 * torch.randn(count, 3, generator=generator))
    return made.activate()


def ordered(gaussians: Gaussians) -> Gaussians:
    """By x, so that files which sort can be compared; quaternions unit, w positive."""
    order = gaussians.means[:, 0].argsort()
    quats = torch.nn.functional.normalize(gaussians.quats, dim=1)
    quats = torch.where(quats[:, :1] < 0, -quats, quats)
    parts = {**vars(gaussians), "quats": quats}
    return Gaussians(**{name: value.detach()[order] for name, value in parts.items()})


def vertices(path: Path, sort: bool = False) -> dict[str, np.ndarray]:
    """A .ply by plyfile; ``sort``: in the order of :func:`ordered`."""
    data = PlyData.read(str(path))["vertex"].data
    order = np.argsort(data["x"], kind="stable") if sort else np.arange(len(data))
    return {name: np.asarray(data[name], np.float64)[order] for name in data.dtype.names}


def columns(found: dict[str, np.ndarray], name: str, count: int) -> np.ndarray:
    return np.stack([found[f"{name}_{i}"] for i in range(count)], 1)


def difference(found: dict[str, np.ndarray], truth: Gaussians) -> dict[str, float]:
    """Largest differences of a .ply's activated columns; rotations in degrees."""
    quats = columns(found, "rot", 4)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    other = torch.nn.functional.normalize(truth.quats.double(), dim=1).numpy()
    chord = np.minimum(np.linalg.norm(quats - other, axis=1), np.linalg.norm(quats + other, axis=1))
    means = np.stack([found[axis] for axis in "xyz"], 1)
    errors = {
        "means": np.abs(means - truth.means.double().numpy()).max(),
        "scales": np.abs(columns(found, "scale", 3) - truth.scales.double().log().numpy()).max(),
        "opacities": np.abs(1 / (1 + np.exp(-found["opacity"])) - truth.opacities.double().numpy()).max(),
        "colors": np.abs(SH_C0 * (columns(found, "f_dc", 3) - truth.sh_dc.double().numpy())).max(),
        "degrees": np.degrees(4 * np.arcsin(chord / 2)).max(),
    }
    rest = 3 * truth.sh_rest.shape[1]
    if rest and "f_rest_0" in found:
        values = columns(found, "f_rest", rest).reshape(len(means), 3, -1).transpose(0, 2, 1)
        errors["harmonics"] = np.abs(values - truth.sh_rest.double().numpy()).max()
    return {name: float(value) for name, value in errors.items()}


def test_ply_is_read_by_plyfile_trimesh_and_splat_transform(tmp_path):
    truth = ordered(cloud())
    write_still(tmp_path / "a.ply", truth)
    assert max(difference(vertices(tmp_path / "a.ply"), truth).values()) < 2e-5
    loaded = trimesh.load(tmp_path / "a.ply")
    np.testing.assert_array_equal(loaded.vertices, truth.means.double().numpy())
    assert float((picture(read_gaussians(tmp_path / "a.ply").activate()) - picture(truth)).abs().max()) < 1e-5
    other = splat_transform(tmp_path / "a.ply", tmp_path / "b.ply")
    assert max(difference(vertices(other), truth).values()) < 2e-5


def test_splat_is_read_by_splat_transform_and_by_us(tmp_path):
    truth = ordered(cloud())
    write_still(tmp_path / "a.splat", truth)
    rows = np.frombuffer((tmp_path / "a.splat").read_bytes(), "<f4").reshape(-1, 8)
    assert len(rows) == 300
    again = ordered(read_gaussians(tmp_path / "a.splat").activate())
    write_still(tmp_path / "again.ply", again)
    limits = {"means": 0.0, "scales": 1e-6, "opacities": 2.1e-3, "colors": 2.1e-3, "degrees": 0.9}
    shown = truth.sh_dc.clamp(-0.5 / SH_C0, 0.5 / SH_C0)  # bytes end at black and white
    limited = Gaussians(**{**vars(truth), "sh_dc": shown})
    found = difference(vertices(tmp_path / "again.ply"), limited)
    assert all(found[name] <= limit for name, limit in limits.items()), found
    first, last = rows[:30, 3:6].prod(1).mean(), rows[-30:, 3:6].prod(1).mean()
    assert first > 10 * last  # what matters most comes first
    # it takes a byte q for 2 q / 255 - 1, where the format's first reader has q / 128 - 1
    found = difference(vertices(splat_transform(tmp_path / "a.splat", tmp_path / "b.ply"), sort=True), limited)
    assert all(found[name] <= limit + 1e-6 for name, limit in {**limits, "degrees": 2.0}.items()), str(found)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_spz_is_read_by_splat_transform_and_by_us(tmp_path, degree):
    truth = ordered(cloud(degree=degree))
    path = tmp_path / "a.spz"
    write_still(path, truth, antialiased=True)
    plain = gzip.decompress(path.read_bytes())
    magic, version, count, said, bits, flags = struct.unpack_from("<IIIBBB", plain)
    assert (magic, version, count, said, flags) == (0x5053474E, 3, 300, degree, 1)
    limits = {"means": 2.0**-bits / 2 + 1e-7, "scales": 1 / 32 + 1e-5, "opacities": 0.5 / 255 + 1e-6,
              "colors": SH_C0 / (0.15 * 255) / 2 + 1e-6, "degrees": 0.2, "harmonics": 0.5 / 128 + 1e-6}  # fmt: skip
    assert limits["means"] < 2e-5
    write_still(tmp_path / "again.ply", read_gaussians(path).activate())
    splat_transform(path, tmp_path / "b.ply")
    for name in ("again.ply", "b.ply"):
        found = difference(vertices(tmp_path / name), truth)
        assert ("harmonics" in found) == (degree > 0)
        assert all(found[part] <= limits[part] for part in found), (name, found)


@pytest.mark.parametrize("version", ["3", "4"])
def test_spz_of_others_is_read(tmp_path, version):
    if version == "4":
        pytest.importorskip("zstandard", reason="the package zstandard is not installed")
    truth = ordered(cloud())
    write_still(tmp_path / "a.ply", truth)
    made = splat_transform(tmp_path / "a.ply", tmp_path / "a.spz", "--spz-version", version)
    assert (made.read_bytes()[:4] == b"NGSP") == (version == "4")
    write_still(tmp_path / "again.ply", read_gaussians(made).activate())
    theirs = vertices(splat_transform(made, tmp_path / "b.ply"))
    ours = vertices(tmp_path / "again.ply")
    found = difference(ours, truth)
    assert found["means"] < 2e-4 and found["harmonics"] < 0.07 and found["degrees"] < 0.3, found
    for name in theirs:  # opaque ones are infinite logits there
        if not name.startswith("rot"):
            np.testing.assert_allclose(ours[name], theirs[name].clip(-13.8155, 13.8155), atol=1e-3, err_msg=name)


@pytest.mark.parametrize("antialiased", [False, True])
def test_spz_keeps_the_mark_of_antialiasing(tmp_path, antialiased):
    write_still(tmp_path / "a.spz", cloud(), antialiased=antialiased)
    export(Request(tmp_path / "b.spz", ply=tmp_path / "a.spz"))
    assert gzip.decompress((tmp_path / "b.spz").read_bytes())[14] == antialiased
    assert open_gaussians(tmp_path / "b.spz", nodes=5).config.antialiased == antialiased
    (tmp_path / "c.spz").write_bytes(b"NGSP" + struct.pack("<IIBBBBI", 4, 1, 0, 12, antialiased, 5, 32))
    assert read_antialiased(tmp_path / "c.spz") == antialiased
    for content in (b"", b"no Gaussians"):
        (tmp_path / "d.spz").write_bytes(content)
        assert not read_antialiased(tmp_path / "d.spz")


def test_spz_says_how_much_it_clips(tmp_path):
    truth = ordered(cloud())
    truth.sh_rest.clamp_(-1.0, 1.0)
    assert write_still(tmp_path / "a.spz", truth) == 0
    truth.sh_rest[4, 2] = torch.tensor([1.5, -1.5, 1.0])
    truth.scales[6, 1] = 1e-6
    assert write_still(tmp_path / "a.spz", truth) == 3


def test_spz_packs_every_rotation(tmp_path):
    generator = np.random.default_rng(3)
    quats = np.concatenate([generator.normal(size=(2000, 4)), np.eye(4), -np.eye(4), np.ones((1, 4))])
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    again = unpack_quats(pack_quats(quats))
    assert np.abs((again * quats).sum(1)).min() > 1 - 2e-6


def test_spz_of_version_2(tmp_path):
    """Three bytes a rotation; written by hand, as nobody writes it any more."""
    quats = np.array([[0.5, 0.5, -0.5, 0.5], [0.8, 0.0, 0.6, 0.0]])
    head = struct.pack("<IIIBBBB", 0x5053474E, 2, 2, 0, 12, 0, 0)
    places = b"".join(int(v).to_bytes(3, "little", signed=True) for v in (4096, -4096, 2048, 0, 8192, -1))
    axes = (127.5 * quats[:, 1:] * (1, -1, -1) + 127.5).round().astype("u1").tobytes()
    content = head + places + b"\x80\xff" + b"\x80" * 6 + b"\x80" * 6 + axes
    (tmp_path / "old.spz").write_bytes(gzip.compress(content))
    found = read_gaussians(tmp_path / "old.spz")
    np.testing.assert_allclose(found.means.detach(), [[1, 1, -0.5], [0, -2, 1 / 4096]], atol=1e-7)
    np.testing.assert_allclose(found.quats.detach(), quats, atol=0.006)
    np.testing.assert_allclose(found.log_scales.detach(), np.full((2, 3), 128 / 16 - 10), atol=1e-6)


def test_a_half_turn_of_harmonics_flips_signs():
    harmonics = torch.randn(20, 15, 3, generator=torch.Generator().manual_seed(1))
    half = torch.tensor([[0.0, 1.0, 0.0, 0.0]]).expand(20, 4).contiguous()
    torch.testing.assert_close(rotate_harmonics(harmonics, half), harmonics * torch.from_numpy(FLIPS)[:, None])


def test_fraction_bits_leave_room():
    means = np.random.default_rng(0).normal(size=(1000, 3))
    assert fraction_bits(means) == 15
    means[0] = 5000.0
    assert fraction_bits(means) == 10 and 5000 * 2**10 < 2**23
    means[0] = 1e8
    with pytest.raises(UserError, match="smaller"):
        fraction_bits(means)


@pytest.mark.parametrize("up", UPS)
def test_upright_turns_up_to_y(up):
    turned = rotate(np.array(upright(up))[[3, 0, 1, 2]], np.array(up))
    np.testing.assert_allclose(turned, [0, 1, 0], atol=1e-12)


def test_glb_holds_the_gaussians_and_renders_the_same(tmp_path):
    truth = ordered(cloud())
    path = tmp_path / "a.glb"
    write_still(path, truth, up=(0.0, 0.0, 1.0))
    found, seen = gltf_arrays(path)
    e = "KHR_gaussian_splatting:"
    extension = seen["gltf"].meshes[0].primitives[0].extensions["KHR_gaussian_splatting"]
    assert extension["kernel"] == "ellipse" and extension["colorSpace"] == "srgb_rec709_display"
    rest = [found[f"{e}SH_DEGREE_{l}_COEF_{n}"] for l in (1, 2, 3) for n in range(2 * l + 1)]
    again = Gaussians(
        *(torch.from_numpy(values).float() for values in (
            found["POSITION"], found[e + "ROTATION"][:, [3, 0, 1, 2]], found[e + "SCALE"], found[e + "OPACITY"][:, 0],
            found[e + "SH_DEGREE_0_COEF_0"], np.stack(rest, 1),
        ))
    )  # fmt: skip
    assert torch.equal(again.means, truth.means) and torch.equal(again.sh_rest, truth.sh_rest)
    assert float((picture(again) - picture(truth)).abs().max()) < 1e-5
    np.testing.assert_allclose(np.linalg.norm(found[e + "ROTATION"], axis=1), 1.0, atol=1e-6)
    scene = trimesh.load(path)
    turned = np.concatenate([item.vertices for item in scene.dump()])
    means = truth.means.double().numpy()
    np.testing.assert_allclose(turned, np.stack([means[:, 0], means[:, 2], -means[:, 1]], 1), atol=1e-6)


def test_glb_is_what_splat_transform_writes_of_the_same_gaussians(tmp_path):
    """It turns the data by half a turn about z; we turn them by the node, about x: half a turn about y apart."""
    truth = ordered(cloud())
    write_still(tmp_path / "a.ply", truth)
    write_still(tmp_path / "a.glb", truth)
    ours, seen = gltf_arrays(tmp_path / "a.glb")
    theirs, _ = gltf_arrays(splat_transform(tmp_path / "a.ply", tmp_path / "b.glb"))
    assert ours.keys() == theirs.keys()
    turned = rotate(np.array(seen["node"].rotation)[[3, 0, 1, 2]], ours["POSITION"])
    np.testing.assert_allclose(turned * (-1, 1, -1), theirs["POSITION"], atol=1e-6)
    for name in ours:
        if "SCALE" in name or "OPACITY" in name or "DEGREE" in name:
            # harmonics of odd order m change sign in half a turn about z
            place = re.search(r"DEGREE_(\d)_COEF_(\d)", name)
            sign = (-1.0) ** (int(place[2]) - int(place[1])) if place else 1.0
            np.testing.assert_allclose(sign * ours[name], theirs[name], atol=2e-6, err_msg=name)


@pytest.mark.parametrize("degree", [0, 3])
def test_glb_is_valid(tmp_path, degree):
    write_still(tmp_path / "a.glb", cloud(degree=degree))
    issues = gltf_errors(tmp_path / "a.glb")
    assert len(issues) == 4 + (degree + 1) ** 2 - 1
    for issue in issues:
        assert issue["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and "KHR_gaussian_splatting" in issue["pointer"]


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".spz"])
def test_files_open_as_scenes_and_as_points(tmp_path, suffix):
    truth = ordered(cloud())
    path = tmp_path / f"a{suffix}"
    write_still(path, truth)
    scene = open_gaussians(path, nodes=20)
    torch.testing.assert_close(ordered(scene.gaussians_at(0.0)).means, truth.means, atol=2e-5, rtol=0)
    assert scene.control_point_count == 20
    for points, colors in (gaussian_points(path), read_points(path)):
        assert colors is not None
        order = np.argsort(points[:, 0])
        np.testing.assert_allclose(points[order], truth.means.double().numpy(), atol=2e-5)
        expected = (0.5 + SH_C0 * truth.sh_dc.double().numpy()).clip(0, 1)
        np.testing.assert_allclose(colors[order], expected, atol=0.005)


def test_damaged_files_are_one_line(tmp_path):
    write_still(tmp_path / "a.spz", cloud())
    good = (tmp_path / "a.spz").read_bytes()
    plain = gzip.decompress(good)
    files = {
        "cut.spz": (good[:-400], "cut short"),
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
    pytest.importorskip("zstandard", reason="the package zstandard is not installed")
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
