"""Compressed .ply files: there and back, through the program that defines them, and files that are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from helpers.export_files import cloud, difference, matched, ordered, picture, ply_columns
from helpers.node_packages import splat_transform
from scgs_warp.data.points import read_points
from scgs_warp.errors import UserError
from scgs_warp.export.still import write_still
from scgs_warp.formats.gaussian_compressed_ply import CHUNK, RANGES, write_compressed_ply
from scgs_warp.formats.gaussian_files import read_gaussians
from scgs_warp.formats.gaussian_ply import write_gaussian_ply
from scgs_warp.types import Gaussians

COUNT = 1000


def plain(path: Path) -> dict[str, np.ndarray]:
    """Read a file and return it as columns of a plain .ply."""
    target = path.with_name(f"{path.name}.again.ply")
    write_still(target, read_gaussians(path).activate())
    return ply_columns(target)


def limits(path: Path, truth: Gaussians) -> dict[str, float]:
    """The largest errors that the format's steps allow, from the ranges in the file."""
    chunk = PlyData.read(str(path))["chunk"].data
    ranges = np.stack([chunk[name] for name in RANGES], 1).reshape(len(chunk), 3, 2, 3)
    width = (ranges[:, :, 1] - ranges[:, :, 0]).max(axis=0)  # of positions, scales, colours
    coarsest = np.array([2047, 1023, 2047])
    found = {
        "means": (width[0] / coarsest).max() / 2 + 1e-6,
        "scales": (width[1] / coarsest).max() / 2 + 1e-5,
        "colors": width[2].max() / 255 / 2 + 1e-6,
        "opacities": 0.5 / 255 + 1e-6,
        "degrees": 0.25,
    }
    return found | ({"harmonics": 0.5 / 32 + 1e-6} if truth.sh_rest.shape[1] else {})


def compare(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> None:
    """Two programs decode one file alike; opaque Gaussians have infinite logits in one of them."""
    for column, values in theirs.items():
        values = values.clip(-13.8155, 13.8155) if column == "opacity" else values
        np.testing.assert_allclose(ours[column], values, atol=2e-4, rtol=1e-6, err_msg=column)


@pytest.mark.parametrize(("degree", "count"), [(0, 1), (1, 256), (2, 257), (3, COUNT)])
def test_there_and_back(tmp_path, degree, count):
    truth, path = ordered(cloud(count, degree)), tmp_path / "a.compressed.ply"
    assert write_compressed_ply(path, truth) == 0
    data = PlyData.read(str(path))
    assert len(data["chunk"]) == -(-count // CHUNK) and len(data["vertex"]) == count
    assert ("sh" in [element.name for element in data]) == (degree > 0)
    assert path.stat().st_size < 2500 + 72 * len(data["chunk"]) + count * (16 + 3 * ((degree + 1) ** 2 - 1))
    allowed, found = limits(path, truth), difference(matched(plain(path), truth), truth)
    assert found.keys() == allowed.keys() and all(found[name] <= allowed[name] for name in found), (found, allowed)
    before = path.read_bytes()
    write_compressed_ply(path, truth)
    assert path.read_bytes() == before


@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_reads_ours_and_we_read_its(tmp_path, degree):
    truth = ordered(cloud(COUNT, degree))
    write_still(tmp_path / "a.ply", truth)
    write_still(tmp_path / "ours.compressed.ply", truth)
    splat_transform(tmp_path / "a.ply", tmp_path / "theirs.compressed.ply")
    for name in ("ours", "theirs"):
        path = tmp_path / f"{name}.compressed.ply"
        seen = ply_columns(splat_transform(path, tmp_path / f"{name}.ply"))
        found, allowed = difference(matched(seen, truth), truth), limits(path, truth)
        assert all(found[part] <= allowed[part] for part in found), (name, found, allowed)
        again = plain(path)
        compare(again, seen)
    sizes = [(tmp_path / f"{name}.compressed.ply").stat().st_size for name in ("ours", "theirs")]
    assert abs(sizes[0] - sizes[1]) < 200


def test_the_public_example_made_by_splat_transform_is_read(tmp_path, data_root):
    source = data_root / "splats" / "tiny_3dgs_9080.ply"
    truth = ordered(read_gaussians(source).activate())
    theirs = splat_transform(source, tmp_path / "tiny.compressed.ply")
    seen = ply_columns(splat_transform(theirs, tmp_path / "tiny.ply"))
    again = plain(theirs)
    assert len(again["x"]) == len(truth.means) == 9080
    compare(again, seen)
    write_still(tmp_path / "ours.compressed.ply", truth)
    for path in (theirs, tmp_path / "ours.compressed.ply"):
        shown = read_gaussians(path).activate()
        assert float((picture(shown) - picture(truth)).detach().square().mean()) < 1e-4


def test_a_packed_file_is_known_by_its_content(tmp_path):
    """SuperSplat's users rename them; a reader of points meets them, too."""
    truth = ordered(cloud(300))
    write_still(tmp_path / "a.compressed.ply", truth)
    (tmp_path / "a.compressed.ply").rename(tmp_path / "a.ply")
    assert difference(matched(plain(tmp_path / "a.ply"), truth), truth)["means"] < 0.01
    points, colors = read_points(tmp_path / "a.ply")
    assert points.shape == (300, 3) and colors is not None and colors.shape == (300, 3)
    write_still(tmp_path / "a.ply", truth)  # plain, under a name that promises a packed one
    (tmp_path / "a.ply").rename(tmp_path / "b.compressed.ply")
    assert difference(plain(tmp_path / "b.compressed.ply"), truth)["means"] == 0.0


def changed(path: Path, element: str, **columns: np.ndarray | None) -> Path:
    """A good file with columns of an element replaced, or removed (None)."""
    data = PlyData.read(str(path), mmap=False)
    rows = data[element].data
    kept = {name: columns.get(name, rows[name]) for name in rows.dtype.names}
    kept = {name: np.asarray(value) for name, value in kept.items() if value is not None}
    table = np.empty(len(next(iter(kept.values()))), dtype=[(name, value.dtype) for name, value in kept.items()])
    for name, value in kept.items():
        table[name] = value
    made = [PlyElement.describe(table, element) if e.name == element else e for e in data]
    PlyData(made).write(str(path))
    return path


def test_files_of_the_first_version_have_no_ranges_of_colours(tmp_path):
    path = tmp_path / "a.compressed.ply"
    write_still(path, cloud(300))
    packed = PlyData.read(str(path))["vertex"].data["packed_color"].astype(np.uint32)
    changed(path, "chunk", **dict.fromkeys(RANGES[12:]))
    red = (packed >> 24) / 255.0
    np.testing.assert_allclose(0.5 + 0.28209479 * read_gaussians(path).sh_dc[:, 0].detach().numpy(), red, atol=1e-6)


def test_what_is_clipped_is_counted(tmp_path):
    truth = ordered(cloud(300))
    truth.sh_rest[4, 2] = torch.tensor([4.5, -4.5, 4.0])
    truth.scales[6, 1] = 0.0
    assert write_still(tmp_path / "a.compressed.ply", truth) == 3
    found = read_gaussians(tmp_path / "a.compressed.ply")
    assert float(found.sh_rest.max()) == 4.0 and float(found.log_scales.min()) == -20.0


def test_bad_files_are_one_line(tmp_path):
    def fresh() -> Path:
        write_still(tmp_path / "a.compressed.ply", cloud(300, 1))
        return tmp_path / "a.compressed.ply"

    words = PlyData.read(str(fresh()))["vertex"].data["packed_scale"]
    codes = PlyData.read(str(fresh()))["sh"].data["f_rest_0"]
    cases = [
        (lambda: changed(fresh(), "vertex", packed_scale=None), "vertex has no packed_scale"),
        (lambda: changed(fresh(), "vertex", packed_scale=words.astype("f4")), "packed_scale that holds unsigned"),
        (lambda: changed(fresh(), "chunk", max_z=None), "chunk has no max_z"),
        (lambda: changed(fresh(), "sh", f_rest_3=None), "8 columns of harmonics"),
        (lambda: changed(fresh(), "sh", f_rest_0=codes.astype("i4")), "f_rest_0 that holds bytes"),
        (lambda: changed(fresh(), "chunk", **{name: np.full(2, np.nan, "f4") for name in RANGES}), "finite"),
        (lambda: changed(fresh(), "chunk", **{name: np.zeros(3, "f4") for name in RANGES}), "3 chunks for 300"),
    ]
    for make, message in cases:
        path = make()
        with pytest.raises(UserError, match=message) as caught:
            read_gaussians(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(UserError, match=r"end the name in \.compressed\.ply"):
        write_compressed_ply(tmp_path / "b.ply", cloud())
    with pytest.raises(UserError, match=r"not in \.compressed\.ply"):
        write_gaussian_ply(tmp_path / "b.compressed.ply", cloud())
    cut = fresh()
    cut.write_bytes(cut.read_bytes()[:-10])
    with pytest.raises(UserError, match="no PLY file"):
        read_gaussians(cut)


def test_gaussians_of_ranges_that_are_not_finite_are_left_out(tmp_path):
    path = tmp_path / "a.compressed.ply"
    write_still(path, cloud(300))
    changed(path, "chunk", max_x=np.array([np.inf, 1.0], "f4"))
    assert len(read_gaussians(path)) == 300 - CHUNK
