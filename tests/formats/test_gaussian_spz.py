"""Files of Niantic's .spz: read by another program, read back, refused when damaged."""

from __future__ import annotations

import gzip
import struct
import tracemalloc

import numpy as np
import pytest
import torch

from helpers.export_files import cloud, difference, ordered, ply_columns, zeros_spz
from helpers.node_packages import splat_transform
from scgs_warp.errors import UserError
from scgs_warp.export.request import ExportRequest
from scgs_warp.export.run import export, write_still
from scgs_warp.formats import gaussian_files
from scgs_warp.formats.gaussian_files import read_gaussians
from scgs_warp.formats.gaussian_spz import FLIPS, fraction_bits, pack_quats, read_antialiased, unpack_quats
from scgs_warp.gaussians import SH_C0
from scgs_warp.ops.harmonics_rotation import rotate_harmonics
from scgs_warp.scene.from_gaussians import open_gaussians


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
        found = difference(ply_columns(tmp_path / name), truth)
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
    theirs = ply_columns(splat_transform(made, tmp_path / "b.ply"))
    ours = ply_columns(tmp_path / "again.ply")
    found = difference(ours, truth)
    assert found["means"] < 2e-4 and found["harmonics"] < 0.07 and found["degrees"] < 0.3, found
    for name in theirs:  # opaque ones are infinite logits there
        if not name.startswith("rot"):
            np.testing.assert_allclose(ours[name], theirs[name].clip(-13.8155, 13.8155), atol=1e-3, err_msg=name)


@pytest.mark.parametrize("antialiased", [False, True])
def test_spz_keeps_the_mark_of_antialiasing(tmp_path, antialiased):
    write_still(tmp_path / "a.spz", cloud(), antialiased=antialiased)
    export(ExportRequest(tmp_path / "b.spz", ply=tmp_path / "a.spz"))
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
