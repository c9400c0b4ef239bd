"""Depth maps of frames: formats, units, sizes, lenses, and mistakes in one line."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.nerfstudio_files import HEIGHT, WIDTH, save, write
from scgs_warp.data import load
from scgs_warp.data.depth_maps import DepthFile, read_depth_map
from scgs_warp.data.lens import make_lens
from scgs_warp.errors import UserError

SIZE = (40, 30)


def ramp(width: int = 40, height: int = 30) -> np.ndarray:
    return np.tile(np.linspace(1.0, 3.0, width), (height, 1)) + np.linspace(0.0, 0.5, height)[:, None]


def saved(folder: Path, name: str, values: np.ndarray) -> Path:
    path = folder / name
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".npz":
        np.savez(path, depth=values)
    else:
        assert cv2.imwrite(str(path), values)
    return path


@pytest.mark.parametrize(
    ("name", "values", "unit"),
    [
        ("a.png", (1000 * ramp()).round().astype(np.uint16), 1e-3),
        ("a.npy", ramp().astype(np.float16), 1.0),
        ("a.npy", 2.0 * ramp(), 0.5),
        ("a.npy", ramp()[..., None].astype(np.float32), 1.0),
        ("a.npz", ramp().astype(np.float32), 1.0),
    ],
)
def test_every_format_gives_the_same_depth(tmp_path, name, values, unit):
    depth = read_depth_map(DepthFile(saved(tmp_path, name, values), unit), SIZE)
    assert depth.dtype == torch.float32 and depth.shape == (30, 40)
    np.testing.assert_allclose(depth.numpy(), ramp(), atol=2e-3)


def test_unknown_depth_is_zero(tmp_path):
    values = ramp().astype(np.float32)
    values[0, :4] = np.nan, np.inf, -1.0, 0.0
    for shaped in (values, values[..., None]):
        depth = read_depth_map(DepthFile(saved(tmp_path, "a.npy", shaped), 2.0), SIZE)
        assert depth[0, :4].tolist() == [0.0] * 4 and bool((depth[1:] > 0).all())
        assert bool(depth.isfinite().all())


def test_maps_may_be_smaller_or_larger_but_must_have_the_proportions(tmp_path):
    for width, height in ((20, 15), (80, 60), (256, 192)):
        path = saved(tmp_path, "a.npy", ramp(width, height))
        assert read_depth_map(DepthFile(path, 1.0), SIZE).shape == (height, width)
    path = saved(tmp_path, "a.npy", ramp(30, 40))
    with pytest.raises(UserError, match="proportions") as caught:
        read_depth_map(DepthFile(path, 1.0), SIZE)
    assert "\n" not in str(caught.value) and "30 x 40" in str(caught.value)


def test_maps_of_a_distorted_image_are_undistorted_with_it(tmp_path):
    """A disc moves as it does in the image; no depth is blended across its outline."""
    lens = make_lens("SIMPLE_RADIAL", (400.0, 200.0, 150.0, 0.4))
    columns, rows = np.meshgrid(np.arange(400) + 0.5, np.arange(300) + 0.5)
    disc = np.hypot(columns - 330, rows - 60) < 25
    depth = read_depth_map(
        DepthFile(saved(tmp_path, "a.npy", np.where(disc, 1.0, 2.0)[::2, ::2]), 1.0), (400, 300), lens
    ).numpy()
    assert depth.shape == (300, 400) and set(np.unique(depth)) <= {0.0, 1.0, 2.0}
    rows, columns = np.nonzero(depth == 1.0)
    x, y = (columns.mean() + 0.5 - 200) / 400, (rows.mean() + 0.5 - 150) / 400
    bent = 1.0 + 0.4 * (x * x + y * y)
    assert np.hypot(200 + 400 * x * bent - 330, 150 + 400 * y * bent - 60) < 1.5


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.png", None, "no such depth map"),
        ("a.npy", None, "no such depth map"),
        ("a.npy", b"not numpy", "no sound numpy file"),
        ("a.png", b"not png", "does not decode as a depth map"),
        ("a.png", np.dstack([np.zeros((30, 40)), np.ones((30, 40)), np.ones((30, 40))]).astype(np.uint8), "no depth"),
        ("a.npy", np.arange(2400.0).reshape(2, 30, 40), "no depth map"),
        ("a.png", np.full((30, 40), 90, np.uint8), "no depth map"),
        ("a.npy", np.zeros((0, 40)), "no depth map"),
        ("a.npy", np.zeros((30, 40, 0)), "no depth map"),
        ("a.npy", np.zeros(40), "no depth map"),
    ],
)
def test_mistakes_in_one_line(tmp_path, name, content, words):
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        saved(tmp_path, name, content)
    with pytest.raises(UserError, match=words) as caught:
        read_depth_map(DepthFile(path, 1.0), SIZE)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_the_layout_names_maps(tmp_path):
    """Frames without the field have none; the unit is millimetres unless it is stated; maps are read when asked for."""
    content = write(tmp_path)
    (tmp_path / "depths").mkdir()
    frames = content["frames"]
    for index in (1, 2):
        saved(tmp_path, f"depths/{index}.png", np.full((HEIGHT, WIDTH), 1500 * index, np.uint16))
        frames[index]["depth_file_path"] = f"depths/{index}.png"
    save(tmp_path, content)
    data = load(tmp_path, "train")
    found = {data.entries[index].name: data.depth(index) for index in data.with_depth}
    assert set(found) == {"f_1", "f_2"}
    assert float(found["f_2"].mean()) == pytest.approx(3.0)
    assert data.depth(next(i for i in range(len(data)) if i not in data.with_depth)) is None
    assert data[data.with_depth[0]].depth is None, "frames are read without their maps"
    save(tmp_path, {**content, "depth_unit_scale_factor": 0.01})
    data = load(tmp_path, "train")
    assert float(data.depth(data.with_depth[0]).mean()) == pytest.approx(15.0)
    assert len(data.subset(data.with_depth).with_depth) == 2


@pytest.mark.parametrize(
    ("fields", "frame", "words"),
    [
        ({}, {"depth_file_path": 3}, "depth_file_path is not text"),
        ({}, {"depth_file_path": "../../etc/passwd"}, "depth_file_path"),
        ({"depth_unit_scale_factor": 0}, {"depth_file_path": "a.png"}, "depth_unit_scale_factor"),
        ({"depth_unit_scale_factor": "mm"}, {"depth_file_path": "a.png"}, "depth_unit_scale_factor"),
    ],
)
def test_mistakes_of_the_layout_in_one_line(tmp_path, fields, frame, words):
    content = write(tmp_path)
    content["frames"][1].update(frame)
    save(tmp_path, {**content, **fields})
    with pytest.raises(UserError, match=words) as caught:
        load(tmp_path, "train")
    assert "\n" not in str(caught.value)
