"""Depth maps give initial points where a data set has no others."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.nerfstudio_files import FOCAL, HEIGHT, WIDTH, save, viewmat, write
from scgs_warp.data import load

BALL = 7.0
"""Radius of the hollow ball about the origin that the cameras, which stand inside, look at."""


def depth_of_ball(index: int) -> np.ndarray:
    """Depth [H, W] of the ball's inside along the camera's z axis."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones_like(rows)], -1)
    view = viewmat(index)
    eye, directions = -view[:3, :3].T @ view[:3, 3], rays @ view[:3, :3]
    a, b, c = (directions**2).sum(-1), 2.0 * directions @ eye, eye @ eye - BALL**2
    return ((-b + np.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)).astype(np.float32)


@pytest.fixture
def content(tmp_path) -> dict:
    """A data set with depth maps, in units of half a world unit, and without points."""
    content = write(tmp_path, depth_unit_scale_factor=0.5)
    del content["ply_file_path"]
    for index, entry in enumerate(content["frames"]):
        entry["depth_file_path"] = f"depth_{index}.npy"
        np.save(tmp_path / f"depth_{index}.npy", 2.0 * depth_of_ball(index))
    save(tmp_path, content)
    return content


def radii(folder: Path) -> torch.Tensor:
    points = load(folder).points
    assert points is not None
    return points.norm(dim=1)


def test_points_lie_on_the_surface_and_have_its_colours(tmp_path, content):
    data = load(tmp_path)
    assert len(radii(tmp_path)) > 10_000 and torch.allclose(radii(tmp_path), torch.tensor(BALL), rtol=1e-4)
    grey = (data.colors - 90 / 255).abs().amax(1) < 1e-3
    assert 0.5 < grey.float().mean() < 1.0, "the dots have other colours"
    assert load(tmp_path, "test").points is None, "training alone needs points"


def test_maps_that_disagree_give_none(tmp_path, content):
    """Metres read as millimetres put the surfaces before each camera."""
    save(tmp_path, {**content, "depth_unit_scale_factor": 0.0005})
    assert load(tmp_path).points is None
    save(tmp_path, content)
    for index in range(0, 20, 2):
        np.save(tmp_path / f"depth_{index}.npy", 3.0 * depth_of_ball(index))
    assert load(tmp_path).points is None, "every other map is of another scale"


def test_a_single_map_is_not_trusted(tmp_path, content):
    for index in range(1, 20):
        (tmp_path / f"depth_{index}.npy").unlink()
    assert load(tmp_path).points is None


def test_masks_exclude_points(tmp_path, content):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 2] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    every = len(radii(tmp_path))
    save(tmp_path, {**content, "frames": [{**entry, "mask_path": "mask.png"} for entry in content["frames"]]})
    kept = radii(tmp_path)
    assert 0.4 * every < len(kept) < 0.55 * every and torch.allclose(kept, torch.tensor(BALL), rtol=1e-4)


def test_given_points_and_cut_out_subjects_come_first(tmp_path, content):
    save(tmp_path, {**content, "ply_file_path": "points.ply"})
    assert len(load(tmp_path).points) == 60
    save(tmp_path, content)
    for index in range(20):
        image = cv2.imread(str(tmp_path / f"f_{index}.png"))
        alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
        alpha[:, :10] = 0
        cv2.imwrite(str(tmp_path / f"f_{index}.png"), np.concatenate([image, alpha], 2))
    assert load(tmp_path).points is None, "a cut-out subject is found by its silhouettes"
