"""The built-in synthetic scene, written in the D-NeRF layout with the true motion beside it.

Monocular as D-NeRF is: each training frame has a time of its own and a camera of its own, drawn from the upper
hemisphere; test frames are spread over time and have other cameras. The same arguments give the same bytes.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import UserError
from ...storage.json_files import parse_json
from ...types import Camera
from .figure import Figure, build_figure
from .orbit_cameras import Shot, camera_of, instants, on_sphere
from .raycast import Raycaster
from .renderer import SURFACE_POINTS, Optics, pick_on_triangles, write_pictures, write_whole

VERSION = 4
"""Raised whenever the scene's pictures or its ground truth change; folders of another version are made anew."""
MARKER = "synthetic.json"
RADIUS = 4.0311
FIELD_OF_VIEW = 0.6911112070083618
"""Radians, D-NeRF's camera_angle_x."""
SINE_OF_ELEVATION = (0.05, 0.85)
SAMPLES = 4
"""Rays per pixel and axis."""


def make_synthetic(
    folder: str | Path,
    size: int = 400,
    train: int = 100,
    test: int = 20,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    device: str = "cpu",
) -> Path:
    """Make the scene in ``folder``, unless it is there already with these arguments.

    An interrupted run leaves nothing half made (``write_whole``).

    Args:
        size: width and height in pixels.
        train: number of frames to train on, each with its own camera.
        test: number of frames held out, each with its own camera.
        seed: of the cameras and of the surface points.
        progress: called with (done, total) after each picture.
        device: where rays are cast, ``cpu`` or ``cuda``.

    Returns:
        The folder: ``transforms_{train,test}.json``, ``train/``, ``test/``, ``ground_truth.npz``, ``synthetic.json``.

    Raises:
        UserError: the folder holds something else, or cannot be written.
    """
    folder = Path(folder)
    if min(size, train, test) < 1 or train < 2:
        raise UserError(f"{folder}: size {size}, train {train}, test {test}; give a size and counts >= 1 (train >= 2)")
    recipe = {"version": VERSION, "size": size, "train": train, "test": test, "seed": seed}
    if _recipe_of(folder) == recipe:
        return folder
    _check_replaceable(folder)
    write_whole(folder, lambda work: _write_scene(work, recipe, progress, device))
    return folder


def _recipe_of(folder: Path) -> dict[str, Any] | None:
    try:
        return parse_json((folder / MARKER).read_text())
    except (OSError, ValueError):
        return None


def _check_replaceable(folder: Path) -> None:
    """Only a synthetic scene or an empty folder gives way."""
    if not folder.exists() or (folder.is_dir() and (_recipe_of(folder) is not None or not any(folder.iterdir()))):
        return
    raise UserError(f"{folder}: exists and holds no synthetic scene ({MARKER}); give another folder, or remove it")


class FigureSubject:
    """The built-in figure, as ``synthesis`` films it."""

    def __init__(self, device: str = "cpu") -> None:
        self.device = device
        self.figure = build_figure()
        self.raycaster = Raycaster(self.figure, device)
        self.pose, self.render, self.visible = self.raycaster.pose, self.raycaster.render, self.raycaster.visible

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Part and place of surface points: see ``sample_surface``."""
        return sample_surface(self.figure, count, rng)

    def track(self, points: tuple[np.ndarray, np.ndarray], times: Sequence[float]) -> np.ndarray:
        """[T, P, 3] float64 world positions of surface points."""
        part, local = points
        tracks = []
        for time in times:
            transforms = self.raycaster.part_transforms(float(time))[part]
            tracks.append(np.einsum("pij,pj->pi", transforms[:, :3, :3], local) + transforms[:, :3, 3])
        return np.stack(tracks)


def _write_scene(work: Path, recipe: dict[str, Any], progress: Callable[[int, int], None] | None, device: str) -> None:
    subject = FigureSubject(device)
    rng = np.random.default_rng(recipe["seed"])
    points = subject.sample(SURFACE_POINTS, rng)
    shots = {
        split: [Shot(time, random_camera(rng), 0) for time in instants(recipe[split])] for split in ("train", "test")
    }
    total = recipe["train"] + recipe["test"]
    counter = itertools.count(1)

    def done() -> None:
        if progress is not None:
            progress(next(counter), total)

    optics = Optics(FIELD_OF_VIEW, recipe["size"], recipe["size"], SAMPLES)
    write_pictures(work, subject, points, shots, optics, done)
    (work / MARKER).write_text(json.dumps(recipe) + "\n")


def random_camera(rng: np.random.Generator) -> np.ndarray:
    """[4, 4] camera-to-world, OpenGL: on the upper hemisphere, evenly over its area, looking at the origin."""
    return on_sphere(rng, SINE_OF_ELEVATION, RADIUS)


def _camera(camera_to_world: np.ndarray, size: int) -> Camera:
    return camera_of(camera_to_world, FIELD_OF_VIEW, size, size)


def sample_surface(figure: Figure, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly by area over all parts: part of each [P], position in that part's bone frame [P, 3].

    Some lie inside a neighbouring part, where no camera sees them; visibility tells.
    """
    face, u, v = pick_on_triangles(figure.local[figure.faces], count, rng)
    a, b, c = figure.local[figure.faces[face]].transpose(1, 0, 2)
    return figure.face_part[face], a + u * (b - a) + v * (c - a)
