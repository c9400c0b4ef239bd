"""Comparison of images far apart in time: where a moving point is seen again, and where none is found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from helpers.ball_and_wall import SIZE
from scgs_warp.data.dataset import Dataset
from scgs_warp.geometry.pinhole import pixels_of
from scgs_warp.training.clouds import Cloud, frame_cloud
from scgs_warp.training.depth import SeenDepth
from scgs_warp.training.flow import Flows
from scgs_warp.training.registration import FARTHEST, Registration
from scgs_warp.types import Camera, Frame

K = torch.tensor([[150.0, 0, SIZE / 2], [0, 150.0, SIZE / 2], [0, 0, 1]])
CAMERA = Camera(torch.eye(4), K, SIZE, SIZE)
DEPTH = 3.0
SHIFT = np.array([11.0, -6.0])
"""Of the pattern from the first frame to the last, pixels."""


def pattern(shift: np.ndarray, seed: int = 0) -> np.ndarray:
    """A smooth random pattern, [h, w, 3], moved by a number of pixels."""
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    x, y = columns - shift[0], rows - shift[1]
    draws = np.random.default_rng(seed)
    waves = [np.sin(x * a + y * b + c) for a, b, c in draws.uniform(-0.4, 0.4, (12, 3))]
    return np.repeat((0.5 + 0.04 * sum(waves))[..., None], 3, 2)


def film(last: np.ndarray) -> Dataset:
    images = [pattern(np.zeros(2)), pattern(SHIFT / 2), last]
    frames = [
        Frame(CAMERA, 0.5 * number, torch.from_numpy(image).float(), None, None, str(number))
        for number, image in enumerate(images)
    ]
    return Dataset(frames, folder=Path("film"), split="train")


class Plane:
    """Depth maps of a plane that all frames see."""

    available = True

    def __init__(self, depth: float = DEPTH) -> None:
        self.seen = SeenDepth(CAMERA, torch.full((SIZE, SIZE), 1.0 / depth))

    def of(self, index: int) -> SeenDepth:
        return self.seen


def cloud() -> Cloud:
    """Points of the first frame around its middle, every second pixel."""
    x, y = np.meshgrid(np.arange(50.0, 110, 2), np.arange(50.0, 110, 2))
    pixels = np.stack([x.ravel(), y.ravel()], 1)
    points = Plane().seen.points_at(pixels, np.full(len(pixels), 1.0 / DEPTH))
    return frame_cloud(0, points, torch.zeros(len(pixels), 3), 0.0, pixels).cloud


def registered(data: Dataset, wrong: tuple[float, float], depths: Plane | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Find the points in the last frame, expected ``wrong`` pixels beside their places; return what is found, and the
    places."""
    depths = depths or Plane()
    registration = Registration(data, Flows(data, [CAMERA] * 3), depths, lambda frame, time: round(2 * time))
    pixels = cloud().pixels.numpy() + SHIFT
    true, expected = (
        Plane().seen.points_at(pixels + off, np.full(len(pixels), 1.0 / DEPTH)) for off in ((0.0, 0.0), wrong)
    )
    return registration.places(cloud(), 1.0, expected), true


def test_an_image_far_away_corrects_expected_places():
    found, true = registered(film(pattern(SHIFT)), (2.5, 1.5))
    known = np.isfinite(found).all(1)
    apart = np.linalg.norm(pixels_of(CAMERA, found[known])[0] - pixels_of(CAMERA, true[known])[0], axis=1)
    assert known.mean() > 0.9 and np.median(apart) < 0.25, "pixels; they were expected 2.9 beside"


def test_nothing_is_found_where_the_image_shows_something_else():
    found, _ = registered(film(pattern(SHIFT, seed=1)), (0.0, 0.0))
    assert np.isfinite(found).all(1).mean() < 0.1


def test_nothing_is_found_behind_what_the_image_shows():
    found, _ = registered(film(pattern(SHIFT)), (0.0, 0.0), Plane(0.8 * DEPTH))
    assert np.isnan(found).all()


def test_nothing_is_found_far_from_the_expected_places():
    found, _ = registered(film(pattern(SHIFT)), (1.5 * FARTHEST * SIZE, 0.0))
    assert np.isfinite(found).all(1).mean() < 0.1


def test_few_points_or_no_frame_find_nothing():
    data, few = film(pattern(SHIFT)), Cloud(*(part[:20] for part in cloud()[:3]), 0.0)
    few = few._replace(frames=torch.zeros(20, dtype=torch.int64), pixels=cloud().pixels[:20])
    flows = Flows(data, [CAMERA] * 3)
    expected = few.points.double().numpy()
    assert np.isnan(Registration(data, flows, Plane(), lambda frame, time: 2).places(few, 1.0, expected)).all()
    whole = cloud().points.double().numpy()
    assert np.isnan(Registration(data, flows, Plane(), lambda frame, time: None).places(cloud(), 1.0, whole)).all()
