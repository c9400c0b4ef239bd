"""Photographs in HEIC, as iPhones take them, are frames like others."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scgs_warp.capture.source import Folder, read_cut_out, read_rgb, turns_of
from scgs_warp.errors import UserError
from scgs_warp.storage import heif_files
from scgs_warp.storage.png_files import write_png

pillow_heif = pytest.importorskip("pillow_heif")
ORIENTATION = 0x112


def picture(width: int = 96, height: int = 64) -> np.ndarray:
    """A smooth picture whose corners differ, which a lossy format hardly changes."""
    y, x = np.mgrid[0:height, 0:width]
    return np.stack([255 * x / width, 255 * y / height, 128 + 0 * x], axis=2).astype(np.uint8)


def write_heic(path: Path, pixels: np.ndarray, orientation: int = 1) -> Path:
    pillow_heif.register_heif_opener()
    image, stream = Image.fromarray(pixels), io.BytesIO()
    exif = image.getexif()
    exif[ORIENTATION] = orientation
    image.save(stream, "HEIF", quality=95, exif=exif.tobytes())
    path.write_bytes(stream.getvalue())
    return path


def close(one: np.ndarray, two: np.ndarray) -> bool:
    return one.shape == two.shape and float(np.abs(one.astype(int) - two).mean()) < 3


def test_a_folder_of_heic(tmp_path):
    for index in range(3):
        write_heic(tmp_path / f"IMG_{index}.HEIC", np.roll(picture(), 8 * index, axis=1))
    frames = list(Folder(tmp_path).frames(1000))
    assert [frame.name for frame in frames] == ["IMG_0.HEIC", "IMG_1.HEIC", "IMG_2.HEIC"]
    assert all(close(frame.image, np.roll(picture(), 8 * index, axis=1)) for index, frame in enumerate(frames))
    assert all(frame.alpha is None for frame in frames)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_photographs_are_upright_as_viewers_show_them(orientation, tmp_path):
    """As a JPEG with the same pixels and the same EXIF tag is shown."""
    heic = write_heic(tmp_path / "a.heic", picture(), orientation)
    image = Image.fromarray(picture())
    exif = image.getexif()
    exif[ORIENTATION] = orientation
    image.save(tmp_path / "a.jpg", quality=98, exif=exif.tobytes())
    jpeg = tmp_path / "a.jpg"
    assert close(read_rgb(heic), read_rgb(jpeg)) and turns_of(heic) == turns_of(jpeg)
    assert heif_files.heif_size(heic) == read_rgb(jpeg).shape[1::-1]


def test_some_held_upright_and_some_not_have_one_size(tmp_path):
    for index, orientation in enumerate((1, 1, 6, 1)):
        write_heic(tmp_path / f"{index}.heic", picture(), orientation)
    frames = list(Folder(tmp_path).frames(1000))
    assert {frame.image.shape for frame in frames} == {(64, 96, 3)}
    assert close(frames[2].image, picture()) and frames[2].turns % 2 == 1


def test_alpha_hides(tmp_path):
    pixels = np.dstack([picture(), np.full((64, 96), 255, np.uint8)])
    pixels[:, :40, 3] = 0
    image, alpha = read_cut_out(write_heic(tmp_path / "a.heic", pixels))
    assert alpha is not None and (alpha[:, :36] < 8).all() and (alpha[:, 44:] > 247).all()
    assert image[:, :30].max() == 0 and close(image[:, 50:], picture()[:, 50:])


def test_a_photograph_of_which_there_is_a_jpeg_counts_once(tmp_path):
    for index in range(2):
        write_heic(tmp_path / f"{index}.heic", picture())
    write_png(tmp_path / "1.png", picture())
    assert [file.name for file in Folder(tmp_path).files] == ["0.heic", "1.png"]


def test_files_that_are_no_heic(tmp_path):
    whole = write_heic(tmp_path / "whole.heic", picture()).read_bytes()
    for name, data in (("cut", whole[: len(whole) // 2]), ("empty", b""), ("text", b"no photograph" * 30)):
        path = tmp_path / f"{name}.heic"
        path.write_bytes(data)
        with pytest.raises(UserError, match=f"{name}.heic: ") as caught:
            read_rgb(path)
        assert "\n" not in str(caught.value)
    broken = bytearray(whole)
    broken[len(whole) // 2 :] = bytes(len(whole) - len(whole) // 2)
    (tmp_path / "broken.heic").write_bytes(broken)
    try:
        assert read_rgb(tmp_path / "broken.heic").shape == (64, 96, 3)
    except UserError as error:
        assert "broken.heic" in str(error)
    (tmp_path / "dir.heic").mkdir()
    with pytest.raises(UserError, match=r"dir.heic: "):
        read_rgb(tmp_path / "dir.heic")


def test_without_the_package_a_command_installs_it(tmp_path, monkeypatch):
    write_heic(tmp_path / "a.heic", picture())
    monkeypatch.setattr(heif_files, "reads_heif", lambda: False)
    with pytest.raises(UserError, match=r'pip install "scgs-warp\[heic\]"'):
        read_rgb(tmp_path / "a.heic")
    with pytest.raises(UserError, match=r'1 photographs .*pip install "scgs-warp\[heic\]"'):
        Folder(tmp_path)
