"""Cameras around a subject at the origin, for synthetic data: random on a sphere, or along a path around the subject.

``camera_to_world`` matrices are OpenGL's (x right, y up, z backward), as the D-NeRF layout writes them. Angles are in
degrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch

from ...geometry.rotation import OPENGL_TO_OPENCV
from ...types import Camera

Arrangement = Literal["sphere", "path"]
FRAMED_RADIUS = 1.365
"""Radius of the largest ball around the origin that fits into the pictures; it determines the distance of the
cameras."""
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
ELEVATION_STRIDE = math.sqrt(2.0) - 1.0
"""Share of the range of elevations between two consecutive cameras of ``surrounding``. It is far from all fractions, so
elevations are even, and unrelated to the golden angle."""


@dataclass(frozen=True)
class FilmingSettings:
    """Settings for the pictures and cameras of a scene."""

    width: int = 400
    height: int = 400
    train: int = 150
    """Number of training instants; all cameras of a rig see each of them."""
    test: int = 20
    val: int = 10
    cameras: Arrangement = "sphere"
    views: int = 1
    """Number of synchronised cameras of a rig; 1 is monocular."""
    fov: float = 39.597752
    """Horizontal field of view; the default is that of D-NeRF."""
    elevation: tuple[float, float] = (2.866, 58.212)
    """Lowest and highest elevation of the cameras."""
    turns: float = 1.0
    """Number of turns of a camera path around the subject."""


class PlannedPicture(NamedTuple):
    """A picture to be rendered: its camera and its time."""

    time: float
    camera_to_world: np.ndarray
    """[4, 4], OpenGL."""
    view: int
    """Index of the camera in a rig; 0 for a single camera."""


def camera_distance(filming: FilmingSettings) -> float:
    """Return the distance of the cameras from the origin."""
    half_x = math.tan(math.radians(filming.fov) / 2)
    narrower = math.atan(half_x * min(1.0, filming.height / filming.width))
    return FRAMED_RADIUS / math.sin(narrower)


def camera_at(azimuth: float, sine: float, radius: float) -> np.ndarray:
    """Return the camera-to-world matrix [4, 4] at an azimuth (radians) and a sine of the elevation; the camera faces
    the origin, z is up."""
    flat = math.sqrt(1.0 - sine * sine)
    backward = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), sine])
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(backward, right), backward], axis=1)
    matrix[:3, 3] = radius * backward
    return matrix


def random_on_sphere(rng: np.random.Generator, sines: tuple[float, float], radius: float) -> np.ndarray:
    """Draw a camera uniformly over the area of the sphere between two sines of elevation."""
    azimuth = rng.uniform(0.0, 2.0 * math.pi)
    return camera_at(azimuth, rng.uniform(*sines), radius)


def surrounding(count: int, sines: tuple[float, float], radius: float, start: float) -> list[np.ndarray]:
    """Place one camera per frame such that consecutive frames look from all sides.

    Azimuths follow the golden angle, elevations a second sequence of low discrepancy. Any nine consecutive cameras (any
    five at the ends) include one within 60 degrees of every horizontal direction, for elevations up to 58 degrees.

    Args:
        count: number of cameras.
        sines: sines of the lowest and highest elevation.
        radius: distance from the origin.
        start: azimuth of the first camera, radians.
    """
    low, high = sines
    cameras = []
    for index in range(count):
        share = ELEVATION_STRIDE * index % 1.0
        cameras.append(camera_at(start + GOLDEN_ANGLE * index, low + (high - low) * share, radius))
    return cameras


def _sines(filming: FilmingSettings) -> tuple[float, float]:
    low, high = filming.elevation
    return math.sin(math.radians(low)), math.sin(math.radians(high))


def rig(filming: FilmingSettings, start: float) -> list[np.ndarray]:
    """Place static cameras evenly over the sphere between the elevations, on a golden-angle spiral."""
    low, high = _sines(filming)
    return [
        camera_at(
            start + GOLDEN_ANGLE * view, low + (high - low) * (view + 0.5) / filming.views, camera_distance(filming)
        )
        for view in range(filming.views)
    ]


def along_path(filming: FilmingSettings, time: float, start: float, view: int) -> np.ndarray:
    """Place a moving camera: it circles the subject ``turns`` times, moving up and down once per turn. The cameras of a
    rig follow each other at equal angles."""
    low, high = filming.elevation
    angle = 2.0 * math.pi * (filming.turns * time + view / filming.views)
    height = math.radians((low + high) / 2 + (high - low) / 2 * math.sin(angle))
    return camera_at(start + angle, math.sin(height), camera_distance(filming))


def instants(count: int) -> list[float]:
    return [index / max(count - 1, 1) for index in range(count)]


def plan_pictures(filming: FilmingSettings, rng: np.random.Generator) -> dict[str, list[PlannedPicture]]:
    """Plan the pictures of each split. Held-out pictures are spread over time, each from a random camera."""
    start = float(rng.uniform(0.0, 2.0 * math.pi))
    standing = rig(filming, start) if filming.cameras == "sphere" and filming.views > 1 else []
    train = []
    for time in instants(filming.train):
        for view in range(filming.views):
            if standing:
                matrix = standing[view]
            elif filming.cameras == "path":
                matrix = along_path(filming, time, start, view)
            else:
                matrix = random_on_sphere(rng, _sines(filming), camera_distance(filming))
            train.append(PlannedPicture(time, matrix, view))
    pictures = {"train": train}
    for split, count in (("test", filming.test), ("val", filming.val)):
        if count:
            poses = [random_on_sphere(rng, _sines(filming), camera_distance(filming)) for _ in range(count)]
            pictures[split] = [PlannedPicture(time, pose, 0) for time, pose in zip(instants(count), poses)]
    return pictures


def camera_of(camera_to_world: np.ndarray, fov: float, width: int, height: int) -> Camera:
    """Make the camera of a picture. ``fov`` is horizontal, in radians."""
    viewmat = np.linalg.inv(camera_to_world @ OPENGL_TO_OPENCV)
    focal = 0.5 * width / math.tan(0.5 * fov)
    K = torch.tensor([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    return Camera(torch.from_numpy(viewmat).float(), K, width, height)
