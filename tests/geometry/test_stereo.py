"""Matched points lie on the surface, behind the pixels whose colours they have."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from helpers import textured_corner as corner
from scgs_warp.geometry.pinhole import pixels_of
from scgs_warp.geometry.stereo import StereoPair
from scgs_warp.types import Camera

ALL = np.ones((corner.HEIGHT, corner.WIDTH), bool)


def sampled(picture: np.ndarray, pixels: np.ndarray, interpolation: int) -> np.ndarray:
    """Return the values [P, C] of a picture [H, W, C] at pixels [P, 2]; the centre of the first is at (0, 0)."""
    parts = np.array_split(pixels.astype(np.float32), len(pixels) // 30_000 + 1)  # OpenCV's largest side
    values = [
        cv2.remap(picture, x[:, None].copy(), y[:, None].copy(), interpolation, borderMode=cv2.BORDER_REPLICATE)
        for x, y in (part.T for part in parts)
    ]
    return np.concatenate(values).reshape(len(pixels), -1)


@pytest.fixture(scope="module")
def matched():
    true = corner.true_cameras(angles=(-6.0, 6.0))
    lens = torch.tensor(
        [[corner.FOCAL, 0, corner.WIDTH / 2], [0, corner.FOCAL, corner.HEIGHT / 2], [0, 0, 1]], dtype=torch.float64
    )
    one, two = (Camera(torch.from_numpy(each.viewmat), lens, each.width, each.height) for each in true.values())
    pictures = tuple(corner.picture(each) for each in true.values())
    pair = StereoPair.of(one, two, corner.surface(true[0])[::16, ::16].reshape(-1, 3))
    points, colors = pair.match(pictures, ALL)
    pixels, depths = pixels_of(one, points)
    assert len(points) > 0.5 * ALL.size and (depths > 0).all()
    return true[0], pictures[0], points, colors, pixels


def test_points_lie_on_the_surface(matched):
    camera, _, points, _, pixels = matched
    surface = corner.surface(camera).astype(np.float32)
    across = np.linalg.norm(points - sampled(surface, pixels, cv2.INTER_LINEAR), axis=1)
    assert np.median(across) < 0.015 and np.quantile(across, 0.9) < 0.1


def test_points_have_the_colours_of_their_pixels(matched):
    """Pictures that lay half a pixel off, and points with them, would still agree with each other."""
    _, picture, _, colors, pixels = matched
    off = {}
    for shift in (0.0, -0.5, 0.5):
        seen = sampled(picture, pixels + shift, cv2.INTER_CUBIC)
        off[shift] = np.abs(seen.astype(int) - colors.astype(int)).mean()
    assert off[0.0] < 0.4 * min(off[-0.5], off[0.5]), off
