"""The EXIF orientation of photographs: all eight values, and who decides."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from helpers.layouts import write_colmap
from scgs_warp.data import load
from scgs_warp.data.orientation import TAG, read_orientation, swaps_sides, upright
from scgs_warp.errors import UserError

PIXELS = np.kron(np.random.default_rng(0).integers(0, 256, (3, 4, 3), dtype=np.uint8), np.ones((16, 16, 1), np.uint8))


def photograph(path: Path | io.BytesIO, orientation: int, format: str = "JPEG") -> None:
    tags = Image.Exif()
    tags[TAG] = orientation
    Image.fromarray(PIXELS).save(path, format, exif=tags, quality=100, subsampling=0)


@pytest.mark.parametrize("format", ["JPEG", "WEBP"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_turned_as_pillow_turns(orientation, format):
    file = io.BytesIO()
    photograph(file, orientation, format)
    assert read_orientation(file.getvalue()) == orientation
    stored = Image.open(io.BytesIO(file.getvalue()))
    shown = np.asarray(ImageOps.exif_transpose(stored))
    turned = upright(np.asarray(stored), orientation)
    assert np.array_equal(turned, shown) and turned.flags.c_contiguous
    assert swaps_sides(orientation) == (shown.shape[0] != PIXELS.shape[0])


@pytest.mark.parametrize("content", [b"", b"\xff\xd8", b"\xff\xd8\xff\xe1\0\x10Exif\0", b"RIFF\0\0\0\0WEBP", b"II*\0"])
def test_damaged_tags_mean_upright(content):
    assert read_orientation(content) == 1


def scene(folder: Path, orientation: int, **size: int) -> Path:
    folder.mkdir()
    entries = []
    for index in range(3):
        photograph(folder / f"{index}.jpg", orientation)
        pose = np.eye(4)
        pose[2, 3] = 3 + index
        entries.append({"file_path": f"{index}.jpg", "transform_matrix": pose.tolist(), "time": index / 2})
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": entries, **size}))
    return folder


def shape(folder: Path) -> tuple[int, ...]:
    return tuple(load(folder)[0].image.shape[:2])


def test_the_size_of_the_camera_decides(tmp_path):
    height, width = PIXELS.shape[:2]
    assert shape(scene(tmp_path / "stored", 6, w=width, h=height)) == (height, width)
    turned = scene(tmp_path / "turned", 6, w=height, h=width)
    assert shape(turned) == (width, height)
    expected = upright(np.asarray(Image.open(turned / "0.jpg")), 6) / 255.0
    assert np.abs(load(turned)[0].image.numpy() - expected).max() < 1e-6
    with pytest.raises(UserError, match=f"w is 9, but the images are {width} x {height}"):
        load(scene(tmp_path / "neither", 6, w=9, h=9))


def test_without_a_size_images_are_turned_as_viewers_show_them(tmp_path):
    height, width = PIXELS.shape[:2]
    assert shape(scene(tmp_path / "quarter", 8)) == (width, height)
    half = load(scene(tmp_path / "half", 3))[0].image.numpy()
    stored = load(scene(tmp_path / "fits", 3, w=width, h=height))[0].image.numpy()
    assert np.array_equal(half, stored[::-1, ::-1]), "where both fit, pixels stay as they are stored"


def test_colmap_reads_either(tmp_path):
    write_colmap(tmp_path, names=lambda index: f"{index}.jpg")
    plain = load(tmp_path)[0].image.shape
    for file in (tmp_path / "images").iterdir():
        image = Image.open(file)
        tags = Image.Exif()
        tags[TAG] = 6
        image.transpose(Image.Transpose.ROTATE_90).save(file, exif=tags)
    assert load(tmp_path)[0].image.shape == plain
