"""Errors of given poses, measured on the images: none with true poses, and about as large as they were made."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scgs_warp.apps import capture as app
from scgs_warp.capture.imports.agreement import TOLERATED, pairs, pose_error

WIDTH, HEIGHT, FOCAL, COUNT = 320, 240, 300.0, 8
K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
SCALE = 100.0
"""Pixels of the wall's picture per unit."""


def view(index: int) -> np.ndarray:
    """[4, 4] world-to-camera of a camera that passes a wall at z = 3 and turns a little."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_euler("yxz", [2.0 * index - 7.0, 0.7 * index, index], degrees=True).as_matrix()
    viewmat[:3, 3] = -viewmat[:3, :3] @ np.array([0.12 * index - 0.4, 0.05 * index, 0.03 * index])
    return viewmat


@pytest.fixture(scope="module")
def filmed() -> tuple[np.ndarray, np.ndarray]:
    """Poses, and images in which something moves in front of the wall."""
    rng = np.random.default_rng(3)
    wall = cv2.resize(rng.integers(0, 256, (120, 160, 3)).astype(np.uint8), (800, 600), interpolation=cv2.INTER_CUBIC)
    mover = cv2.resize(rng.integers(0, 256, (15, 12, 3)).astype(np.uint8), (70, 80), interpolation=cv2.INTER_CUBIC)
    viewmats = np.stack([view(index) for index in range(COUNT)])
    images = []
    for index, viewmat in enumerate(viewmats):
        # A wall pixel (u, v), with centres at one half, lies at ((u - 400) / SCALE, (v - 300) / SCALE, 3).
        place = np.array([[1 / SCALE, 0, -400 / SCALE], [0, 1 / SCALE, -300 / SCALE], [0, 0, 3.0]])
        half = np.array([[1.0, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
        to_image = np.linalg.inv(half) @ K @ (viewmat[:3, :3] @ place + np.outer(viewmat[:3, 3], [0, 0, 1])) @ half
        image = cv2.warpPerspective(wall, to_image, (WIDTH, HEIGHT), flags=cv2.INTER_AREA)
        image[100:180, 20 + 25 * index : 90 + 25 * index] = mover
        images.append(image)
    return viewmats, np.stack(images)


def error_of(viewmats: np.ndarray, images: np.ndarray) -> float | None:
    seen = []
    error = pose_error(lambda index: images[index], viewmats, [K] * len(images), lambda: seen.append(1))
    assert len(seen) == len(pairs(len(images)))
    return error


def test_true_poses_agree(filmed):
    error = error_of(*filmed)
    assert error is not None and error < 0.1


def test_wrong_poses_do_not(filmed):
    viewmats, images = filmed
    rng, errors = np.random.default_rng(0), []
    for degrees in (0.3, 1.0):
        wrong = viewmats.copy()
        for index in range(COUNT):
            turn = Rotation.from_rotvec(np.radians(degrees) * rng.normal(size=3)).as_matrix()
            wrong[index, :3] = turn @ viewmats[index, :3]
        errors.append(error_of(wrong, images))
    pixel = FOCAL * np.radians(1.0)
    assert errors[0] is not None and TOLERATED < errors[0] < pixel
    assert errors[1] is not None and 0.5 * pixel < errors[1] < 3 * pixel


def test_cameras_at_one_place_and_bare_images(filmed):
    viewmats, images = filmed
    assert error_of(np.tile(np.eye(4), (COUNT, 1, 1)), images) is None
    assert error_of(viewmats, np.full_like(images, 128)) is None
    assert error_of(viewmats[:2], images[:2]) is None, "one pair is not enough"
    assert len(set(pairs(500))) == 24 and (0, 25) in pairs(500) and pairs(2) == [(0, 1)]


def test_the_next_command_corrects_weak_poses(filmed, tmp_path, capsys):
    viewmats, images = filmed
    wrong = viewmats.copy()
    for index in range(COUNT):
        turn = Rotation.from_euler("xyz", [0.8 * (-1.0) ** index, 0.0, 0.6 * (index % 3)], degrees=True)
        wrong[index, :3] = turn.as_matrix() @ viewmats[index, :3]
    for name, poses, corrected in (("true", viewmats, False), ("wrong", wrong, True)):
        file = tmp_path / f"{name}.npz"
        np.savez(file, images=images, intrinsic=K, cam_c2w=np.linalg.inv(poses))
        assert app.cli(["--poses", str(file), "--output", str(tmp_path / name), "--device", "cpu"]) == 0
        printed = capsys.readouterr().out.strip().splitlines()
        assert printed[-1].endswith("--set optim.cameras=2e-4") == corrected
        assert any("the poses differ from the images by" in line for line in printed) == corrected
