"""Images of a COLMAP model under other names and at other sizes than the model states."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.data_faults import message
from helpers.layouts import HEIGHT, WIDTH, K, save_image, share_found, write_colmap, write_poses_bounds
from scgs_warp.data import load

FOUND = 0.75
"""Share of the points whose colour is at their pixel; the others hide."""


def reduce_images(folder: Path, ratio: float, to: str, name: Callable[[int, str], str] | None = None) -> None:
    """Move the images to another folder, smaller and under other names."""
    size = (round(WIDTH / ratio), round(HEIGHT / ratio))
    for index, file in enumerate(sorted((folder / "images").iterdir())):
        image = cv2.resize(cv2.imread(str(file)), size, interpolation=cv2.INTER_NEAREST)
        file.unlink()
        save_image(folder / to / (name(index, file.stem) if name else file.name), image)


NAMES = {
    "same": None,
    "png": lambda index, stem: f"{stem}.png",
    "order": lambda index, stem: f"image{index:03d}.png",
}


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL", "OPENCV_FISHEYE"])
@pytest.mark.parametrize("names", NAMES)
def test_reduced_images_alone(tmp_path, model, names):
    """As people keep Mip-NeRF 360's scenes and LLFF's, whose full-size images take gigabytes."""
    write_colmap(tmp_path, model=model, names=lambda index: f"_DSC{index + 5}.JPG")
    reduce_images(tmp_path, 2, "images_2", NAMES[names])
    shutil.copytree(tmp_path / "images_2", tmp_path / "images_8")
    (tmp_path / "images").rmdir()
    train, test = load(tmp_path), load(tmp_path, "test")
    # Files of JPEG are not exact.
    assert min(share_found(train, 0.3), share_found(test, 0.3)) > FOUND
    assert {(frame.camera.width, frame.camera.height) for frame in train} == {(WIDTH // 2, HEIGHT // 2)}
    assert len(train) == 12 and train[0].name == "_DSC5"
    line = f"{tmp_path / 'images_2'}: images are 40 x 30 pixels, the model's cameras 80 x 60 pixels"
    assert any(note.startswith(line) for note in train.notes)
    assert any("other names" in note for note in train.notes) == (names != "same")


def test_downscale_counts_from_the_full_size(tmp_path):
    write_colmap(tmp_path)
    reduce_images(tmp_path, 4, "images_4")
    assert {downscale: load(tmp_path, downscale=downscale)[0].camera.width for downscale in (1, 2, 4, 5)} == {
        1: 20,
        2: 20,
        4: 20,
        5: 16,
    }


def test_full_size_images_are_preferred(tmp_path):
    write_colmap(tmp_path)
    shutil.copytree(tmp_path / "images", tmp_path / "images_2")
    data = load(tmp_path)
    assert data[0].camera.width == WIDTH and data.notes == ()


def test_all_images_are_smaller(tmp_path):
    """As 3D Gaussian Splatting's Tanks and Temples are, by rounding in odd proportions."""
    write_colmap(tmp_path)
    shutil.move(tmp_path / "images", tmp_path / "full")
    for file in sorted((tmp_path / "full").iterdir()):
        save_image(tmp_path / "images" / file.name, cv2.resize(cv2.imread(str(file)), (40, 31)))
    data = load(tmp_path)
    expected = K * np.array([[0.5], [31 / HEIGHT], [1.0]])
    torch.testing.assert_close(data[0].camera.K, torch.from_numpy(expected).float())
    assert load(tmp_path, downscale=2)[0].camera.width == 20
    assert "cameras are scaled to the images" in data.notes[0]


@pytest.mark.parametrize("size", [(WIDTH - 4, HEIGHT - 3), (2 * WIDTH, 2 * HEIGHT), (WIDTH // 2, HEIGHT // 2 + 2)])
def test_images_of_another_model(tmp_path, size):
    """Undistorted images may be smaller in the same proportions."""
    write_colmap(tmp_path)
    for file in sorted((tmp_path / "images").iterdir()):
        save_image(file, cv2.resize(cv2.imread(str(file)), size))
    assert f"is of 80 x 60 pixels, but the image is {size[0]} x {size[1]}" in message(tmp_path)


def test_images_converted_to_another_format(tmp_path):
    """As after the removal of backgrounds, whose alpha JPEG does not hold."""
    write_colmap(tmp_path, names=lambda index: f"cam{index % 2}/frame_{index}.JPG")
    for file in sorted((tmp_path / "images").rglob("*.JPG")):
        save_image(file.with_suffix(".png"), cv2.imread(str(file)))
        file.unlink()
    data = load(tmp_path)
    assert share_found(data, 0.3) > FOUND
    assert data.notes == (
        f"{tmp_path / 'images'}: images of other names than in the model are used, such as frame_0.png for frame_0.JPG",
    )


def test_an_order_of_other_length_means_nothing(tmp_path):
    write_colmap(tmp_path)
    reduce_images(tmp_path, 2, "images_2", NAMES["order"])
    (tmp_path / "images_2/image003.png").unlink()
    assert "the images of 14 of 14 frames are missing" in message(tmp_path)


def test_reduced_images_beside_the_bounds_of_llff(tmp_path):
    write_poses_bounds(tmp_path / "rig", cameras=4)
    write_colmap(tmp_path)
    shutil.copy(tmp_path / "rig/poses_bounds.npy", tmp_path)
    reduce_images(tmp_path, 4, "images_4")
    shutil.rmtree(tmp_path / "images")
    shutil.rmtree(tmp_path / "rig")
    assert load(tmp_path)[0].camera.width == WIDTH // 4
