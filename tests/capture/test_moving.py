"""Masks of what moves: found in the optical flow, or given by the user."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from helpers.films import mask_images, pan, wall
from scgs_warp.capture import moving
from scgs_warp.capture.source import Folder, Video
from scgs_warp.errors import UserError
from scgs_warp.visualization.video import film


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
    masks = moving.find_moving(lambda k: scenes[k][0], 6, lambda: None)
    for mask, (_, truth) in zip(masks, scenes):
        assert (mask & truth).sum() > 0.8 * truth.sum()
        assert (mask & ~truth).sum() < 0.04 * truth.size


def test_nothing_moves_in_a_scene_at_rest_or_without_texture():
    rest = pan(range(0, 24, 4), 240, 320)
    assert max(mask.mean() for mask in moving.find_moving(lambda k: rest[k], 6, lambda: None)) < 0.01
    grey = np.full((240, 320, 3), 90, np.uint8)
    assert not any(mask.any() for mask in moving.find_moving(lambda k: grey, 3, lambda: None))


def test_masks_that_are_given(tmp_path):
    frames = mask_images(tmp_path / "frames", 12, (320, 240))
    masks = mask_images(tmp_path / "masks", 12)
    names = [f"{index:03d}.png" for index in (2, 7)]
    by_name = moving.read_masks(masks, Folder(frames), [2, 7], names, (320, 240))
    assert by_name[0][20:60, 20:60].all() and by_name[1][20:60, 70:110].all()
    assert [mask.sum() for mask in by_name] == [1600, 1600]
    with film(tmp_path / "frames.mp4") as out:
        for file in sorted(frames.iterdir()):
            out.write(cv2.imread(str(file)))
    video = Video(tmp_path / "frames.mp4")
    by_order = moving.read_masks(masks, video, [2, 7], ["", ""], (320, 240))
    by_film = moving.read_masks(tmp_path / "frames.mp4", video, [2, 7], ["", ""], (320, 240))
    few = mask_images(tmp_path / "few", 8, name="frame_{:05d}.png")
    by_number = moving.read_masks(few, video, [2, 7], ["", ""], (320, 240))
    for found in (by_order, by_number):
        assert all(np.array_equal(a, b) for a, b in zip(by_name, found))
    for index, mask in zip((2, 7), by_film):
        assert mask[11:29, 5 * index + 1 : 5 * index + 19].all() and mask.sum() < 500


def test_masks_that_do_not_fit(tmp_path):
    frames, masks = Folder(mask_images(tmp_path / "frames", 12)), mask_images(tmp_path / "masks", 6)
    with pytest.raises(UserError, match=r"masks: no mask for 007 \(1 of 2"):
        moving.read_masks(masks, frames, [2, 7], ["002.png", "007.png"], (160, 120))
    with pytest.raises(UserError, match="proportions"):
        moving.read_masks(masks, frames, [2], ["002.png"], (160, 160))
    with film(tmp_path / "short.mp4") as out:
        for _ in range(4):
            out.write(np.zeros((120, 160, 3), np.uint8))
    with pytest.raises(UserError, match="ends before frame 7"):
        moving.read_masks(tmp_path / "short.mp4", frames, [2, 7], ["", ""], (160, 120))
