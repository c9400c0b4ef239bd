"""A rig of five cameras before the ball and the wall, and its depth by stereo."""

from __future__ import annotations

from collections.abc import Callable

import torch

from helpers.ball_and_wall import standing_camera
from scgs_warp.data.dataset import Dataset
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.training.standing_cameras import standing_cameras
from scgs_warp.training.stereo_depth import StereoDepths
from scgs_warp.types import Camera, Frame

ANGLES = (-20.0, -10.0, 0.0, 10.0, 20.0)
HEIGHTS = (0.3, 0.8, 0.3, 0.8, 0.3)
MOMENTS = 7


def place_at(time: float) -> torch.Tensor:
    """The ball crosses from left to right in a low arc."""
    return torch.tensor([1.2 * time - 0.6, 0.0, 0.3 * time * (1 - time)])


def rig_views(angles=ANGLES, heights=HEIGHTS, moments: int = MOMENTS) -> list[tuple[Camera, float]]:
    return [
        (standing_camera(angle, height), moment / (moments - 1))
        for angle, height in zip(angles, heights)
        for moment in range(moments)
    ]


def changed_film(film: Dataset, change: Callable[[Frame, int], Frame]) -> Dataset:
    """The film with changed frames; the second argument of ``change`` is a frame's index."""
    frames = [change(frame, index) for index, frame in enumerate(film)]
    return Dataset(frames, folder=film.folder, split="train", points=film.points, colors=film.colors)


def standing_in(film: Dataset):
    normalisation = Normalisation.fit(film.cameras, film.points)
    views = [normalisation.apply_camera(camera) for camera in film.cameras]
    return normalisation, standing_cameras(film, views)


def stereo_of(film: Dataset) -> tuple[Normalisation, StereoDepths]:
    normalisation, standing = standing_in(film)
    return normalisation, StereoDepths(normalisation.apply(film.points).float(), film, standing)
