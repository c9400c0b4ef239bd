"""Masks of what moves, found in the optical flow."""

from __future__ import annotations

import numpy as np

from helpers.films import pan, wall
from scgs_warp.capture import moving


def planes(index: int) -> tuple[np.ndarray, np.ndarray]:
    """Two textured planes at rest, one nearer, before a camera that goes sideways; a square that goes up: picture, its
    pixels."""
    picture = pan([40 + 4 * index], 240, 320)[0]
    near = wall(5, 90)
    picture[150:] = near[:, 60 + 11 * index : 380 + 11 * index]
    mask = np.zeros(picture.shape[:2], bool)
    mask[120 - 8 * index : 180 - 8 * index, 140:200] = True
    picture[mask] = wall(8)[:60, :60].reshape(-1, 3)
    return picture, mask


def test_what_leaves_its_epipolar_line_moves():
    scenes = [planes(index) for index in range(6)]
    masks = moving.find_moving(lambda k: scenes[k][0], 6)
    for mask, (_, truth) in zip(masks, scenes):
        assert (mask & truth).sum() > 0.8 * truth.sum()
        assert (mask & ~truth).sum() < 0.04 * truth.size


def test_nothing_moves_in_a_scene_at_rest_or_without_texture():
    rest = pan(range(0, 24, 4), 240, 320)
    assert max(mask.mean() for mask in moving.find_moving(lambda k: rest[k], 6)) < 0.01
    grey = np.full((240, 320, 3), 90, np.uint8)
    assert not any(mask.any() for mask in moving.find_moving(lambda k: grey, 3))
