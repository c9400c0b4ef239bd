"""Files of Niantic's .spz: read by another program, read back, refused when damaged."""

from __future__ import annotations

import gzip
import struct
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.export_files import cloud, difference, ordered, picture, ply_columns, turned, zeros_spz
from helpers.node_packages import SPLAT_TRANSFORM, package, splat_transform, version_of
from scgs_warp.edit.rotations import multiply
from scgs_warp.errors import UserError
from scgs_warp.export.request import ExportRequest
from scgs_warp.export.run import export
from scgs_warp.export.still import losses, write_still
from scgs_warp.formats import gaussian_files, gaussian_spz
from scgs_warp.formats.gaussian_files import read_antialiased, read_gaussians
from scgs_warp.formats.gaussian_spz import FLIPS, fraction_bits, pack_quats, unpack_quats
from scgs_warp.formats.spz_axes import NAMES
from scgs_warp.formats.spz_container import EXTENDED, SpzHead, pack_gzip, pack_streams
from scgs_warp.gaussians import SH_C0
from scgs_warp.geometry.rotation import rotate
from scgs_warp.ops.harmonics_rotation import rotate_harmonics
from scgs_warp.scene.from_gaussians import open_gaussians
from scgs_warp.types import Gaussians


def header(path: Path) -> tuple[int, ...]:
    """Magic number, version, count, degree, fractional bits, flags."""
    content = path.read_bytes()
    return struct.unpack_from("<IIIBBB", content if content[:4] == b"NGSP" else gzip.decompress(content))


def seen_by(program: Path) -> tuple[int, int, int]:
    """The signs of the axes as splat-transform understands a .spz: from version 3 on it takes those of a .ply."""
    return (1, 1, 1) if version_of(program) < (3,) else (1, -1, -1)


@pytest.mark.parametrize("spz_version", [3, 4])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_spz_is_read_by_splat_transform_and_by_us(tmp_path, degree, spz_version):
    truth = ordered(cloud(degree=degree))
    path = tmp_path / "a.spz"
    write_still(path, truth, antialiased=True, spz_version=spz_version)
    magic, version, count, said, bits, flags = header(path)
    assert (magic, version, count, said, flags) == (0x5053474E, spz_version, 300, degree, 1)
    limits = {"means": 2.0**-bits / 2 + 1e-7, "scales": 1 / 32 + 1e-5, "opacities": 0.5 / 255 + 1e-6,
              "colors": SH_C0 / (0.15 * 255) / 2 + 1e-6, "degrees": 0.2, "harmonics": 0.5 / 128 + 1e-6}  # fmt: skip
    assert limits["means"] < 2e-5
    write_still(tmp_path / "again.ply", read_gaussians(path).activate())
    found = difference(ply_columns(tmp_path / "again.ply"), truth)
    assert ("harmonics" in found) == (degree > 0)
    assert all(found[part] <= limits[part] for part in found), found
    theirs = turned(ply_columns(splat_transform(path, tmp_path / "b.ply")), seen_by(package(SPLAT_TRANSFORM)))
    found = difference(theirs, truth)
    assert all(found[part] <= limits[part] for part in found), found


def test_the_versions_hold_the_same_values_and_4_is_smaller(tmp_path):
    truth = cloud(2000)
    for version in (3, 4):
        write_still(tmp_path / f"{version}.spz", truth, spz_version=version)
    old, new = (read_gaussians(tmp_path / f"{version}.spz") for version in (3, 4))
    assert all(torch.equal(a, b) for a, b in zip(old.parameters(), new.parameters()))
    assert (tmp_path / "4.spz").stat().st_size < 1.02 * (tmp_path / "3.spz").stat().st_size
    write_still(tmp_path / "default.spz", truth)
    assert (tmp_path / "default.spz").read_bytes() == (tmp_path / "4.spz").read_bytes()


@pytest.mark.parametrize("version", ["3", "4"])
def test_spz_of_others_is_read(tmp_path, version):
    truth = ordered(cloud())
    write_still(tmp_path / "a.ply", truth)
    made = splat_transform(tmp_path / "a.ply", tmp_path / "a.spz", "--spz-version", version)
    assert (made.read_bytes()[:4] == b"NGSP") == (version == "4")
    write_still(tmp_path / "again.ply", read_gaussians(made).activate())
    theirs = turned(ply_columns(splat_transform(made, tmp_path / "b.ply")), seen_by(package(SPLAT_TRANSFORM)))
    ours = ply_columns(tmp_path / "again.ply")
    found = difference(turned(ours, seen_by(package(SPLAT_TRANSFORM))), truth)
    assert found["means"] < 2e-4 and found["harmonics"] < 0.07 and found["degrees"] < 0.3, found
    for name in theirs:  # opaque ones are infinite logits there
        if not name.startswith("rot"):
            np.testing.assert_allclose(ours[name], theirs[name].clip(-13.8155, 13.8155), atol=1e-3, err_msg=name)


@pytest.mark.parametrize("spz_version", [3, 4])
@pytest.mark.parametrize("antialiased", [False, True])
def test_spz_keeps_the_mark_of_antialiasing(tmp_path, antialiased, spz_version):
    write_still(tmp_path / "a.spz", cloud(), antialiased=antialiased)
    export(ExportRequest(tmp_path / "b.spz", ply=tmp_path / "a.spz", spz_version=spz_version))
    assert header(tmp_path / "b.spz")[1::4] == (spz_version, antialiased)
    assert open_gaussians(tmp_path / "b.spz", nodes=5).config.antialiased == antialiased
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


def test_positions_that_are_rounded_visibly_are_told(tmp_path):
    path = tmp_path / "a.spz"
    for shift, scale, words in (
        (0.0, 1.0, ""),
        (1e5, 1.0, "positions rounded to 0.016,"),
        (0.0, 1e-5, "rounded to 6e-08"),
    ):
        truth = replace(cloud(), means=cloud().means.detach() * scale + shift)
        note = losses(path, truth, write_still(path, truth))
        assert (words in note) if words else "rounded" not in note, note
    assert "rounded" not in losses(tmp_path / "a.ply", truth, 0)


def test_spz_packs_every_rotation(tmp_path):
    generator = np.random.default_rng(3)
    quats = np.concatenate([generator.normal(size=(2000, 4)), np.eye(4), -np.eye(4), np.ones((1, 4))])
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    again = unpack_quats(pack_quats(quats))
    assert np.abs((again * quats).sum(1)).min() > 1 - 2e-6


@pytest.mark.parametrize("version", [1, 2])
def test_spz_of_the_first_versions(tmp_path, version):
    """Three bytes a rotation; written by hand, as nobody writes them any more."""
    quats = np.array([[0.5, 0.5, -0.5, 0.5], [0.8, 0.0, 0.6, 0.0]])
    head = struct.pack("<IIIBBBB", 0x5053474E, version, 2, 0, 12, 0, 0)
    places = b"".join(int(v).to_bytes(3, "little", signed=True) for v in (4096, -4096, 2048, 0, 8192, -1))
    if version == 1:  # half floats
        places = np.array([1, -1, 0.5, 0, 2, -1 / 4096], "<f2").tobytes()
    axes = (127.5 * quats[:, 1:] * (1, -1, -1) + 127.5).round().astype("u1").tobytes()
    content = head + places + b"\x80\xff" + b"\x80" * 6 + b"\x80" * 6 + axes
    (tmp_path / "old.spz").write_bytes(gzip.compress(content))
    found = read_gaussians(tmp_path / "old.spz")
    np.testing.assert_allclose(found.means.detach(), [[1, 1, -0.5], [0, -2, 1 / 4096]], atol=1e-7)
    np.testing.assert_allclose(found.quats.detach(), quats, atol=0.006)
    np.testing.assert_allclose(found.log_scales.detach(), np.full((2, 3), 128 / 16 - 10), atol=1e-6)


def pieces(truth: Gaussians) -> tuple[SpzHead, list[np.ndarray]]:
    """Header and arrays of a good file of version 4."""
    made: list[tuple[SpzHead, list[np.ndarray]]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gaussian_spz, "pack_streams", lambda path, head, parts: made.append((head, parts)) or b"")
        patch.setattr(gaussian_spz, "write_atomically", lambda path, content: None)
        gaussian_spz.write_spz("a.spz", truth)
    return made[0]


def test_harmonics_of_degree_4_are_left_out(tmp_path):
    truth = cloud()
    head, parts = pieces(truth)
    more = np.concatenate([parts[5], np.full((300, 9, 3), 77, "u1")], 1)
    for name, pack in (("a.spz", pack_streams), ("b.spz", lambda _, *rest: pack_gzip(*rest))):
        version = 4 if name == "a.spz" else 3
        content = pack(Path(name), replace(head, degree=4, version=version), [*parts[:5], more])
        (tmp_path / name).write_bytes(content)
        write_still(tmp_path / "plain.spz", truth)
        found, plain = read_gaussians(tmp_path / name), read_gaussians(tmp_path / "plain.spz")
        assert torch.equal(found.sh_rest, plain.sh_rest) and torch.equal(found.means, plain.means)


AXES = {"RDF": (1, 1, 1), "LUF": (-1, -1, 1), "RUF": (1, -1, 1), "LDB": (-1, 1, -1)}
"""Axes without permutation: the signs of their coordinates in the frame of a .ply. The last two are left-handed."""


@pytest.mark.parametrize("name", [*AXES, "RUB", "RFU"])
@pytest.mark.parametrize("version", [3, 4])
def test_axes_that_an_extension_names_are_respected(tmp_path, name, version):
    """The same scene, written in other coordinates: read back, it looks the same."""
    truth = ordered(cloud())
    truth.sh_rest.clamp_(-0.9, 0.9)
    if name == "RFU":  # z is up: a quarter turn about x from the frame of a .ply
        quarter = torch.tensor([[0.5**0.5, -(0.5**0.5), 0.0, 0.0]]).expand(300, 4)
        stored = replace(
            truth,
            means=rotate(quarter, truth.means),
            quats=torch.from_numpy(multiply(quarter.double().numpy(), truth.quats.double().numpy())).float(),
            sh_rest=rotate_harmonics(truth.sh_rest, quarter.contiguous()),
        )
    else:
        x, y, z = AXES.get(name, (1, -1, -1))
        signs = torch.tensor([y, z, x, x * y, y * z, 1, x * z, 1, y, x * y * z, y, z, x, z, x])
        stored = replace(
            truth,
            means=truth.means * torch.tensor([x, y, z]),
            quats=truth.quats * torch.tensor([1, y * z, x * z, x * y]),
            sh_rest=truth.sh_rest * signs[:, None],
        )
    # The writer turns to right, up, back; start from what it turns so that the bytes are in these coordinates.
    half = torch.tensor([[0.0, 1.0, 0.0, 0.0]]).expand(300, 4).contiguous()
    undone = replace(
        stored,
        means=stored.means * torch.tensor([1.0, -1.0, -1.0]),
        quats=torch.from_numpy(multiply(half.double().numpy(), stored.quats.double().numpy())).float(),
        sh_rest=rotate_harmonics(stored.sh_rest, half),
    )
    head, parts = pieces(undone)
    number = NAMES.index(name) + 1
    extra = struct.pack("<IIQ", 0xADBE0002, 8, 0) + struct.pack("<III", 0xADBE0003, 4, number)
    path = tmp_path / "a.spz"
    if version == 4:
        content = pack_streams(path, replace(head, flags=EXTENDED), parts)
        content = content[:16] + struct.pack("<I", 32 + len(extra)) + content[20:32] + extra + content[32:]
    else:
        plain = gzip.decompress(pack_gzip(replace(head, version=3, flags=EXTENDED), parts))
        content = gzip.compress(plain + extra)
    path.write_bytes(content)
    shown = read_gaussians(path).activate()
    write_still(tmp_path / "again.ply", shown)
    found = difference(ply_columns(tmp_path / "again.ply"), truth)
    assert found["means"] < 2e-5 and found["harmonics"] < 1.5 / 128, found  # a turn mixes rounded coefficients
    write_still(tmp_path / "plain.spz", truth)  # a rotation is known up to half turns about the Gaussian's own axes
    assert float((picture(shown) - picture(read_gaussians(tmp_path / "plain.spz").activate())).abs().max()) < 5e-3
    if version == 4:
        place = content.index(struct.pack("<III", 0xADBE0003, 4, number)) + 8
        path.write_bytes(content[:place] + b"c" + content[place + 1 :])
        with pytest.raises(UserError, match="axes number 99"):
            read_gaussians(path)


def test_damage_is_found_by_check_sums(tmp_path):
    """One flipped bit anywhere in the data: of the header alone, some bits are free."""
    for version, first in ((3, 30), (4, 140)):
        path = tmp_path / f"{version}.spz"
        write_still(path, cloud(), spz_version=version)
        content = path.read_bytes()
        for place in np.random.default_rng(0).integers(first, len(content), 60):
            changed = bytearray(content)
            changed[place] ^= 1 << int(place) % 8
            path.write_bytes(changed)
            with pytest.raises(UserError):
                read_gaussians(path)
        for cut in (1, 4, 9):
            path.write_bytes(content[:-cut])
            with pytest.raises(UserError, match="cut short"):
                read_gaussians(path)
    path.write_bytes(content + b"more")
    with pytest.raises(UserError, match="damaged"):
        read_gaussians(path)


def test_a_missing_package_is_one_line(tmp_path, monkeypatch):
    write_still(tmp_path / "a.spz", cloud())
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(UserError, match="read with the package zstandard: pip install zstandard"):
        read_gaussians(tmp_path / "a.spz")
    with pytest.raises(UserError, match="or give --spz-version 3"):
        write_still(tmp_path / "b.spz", cloud())
    write_still(tmp_path / "b.spz", cloud(), spz_version=3)
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["a.spz", "b.spz"]


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
    with pytest.raises(UserError, match=r"write a \.ply"):
        fraction_bits(means)


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
