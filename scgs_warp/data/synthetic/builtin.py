"""The built-in synthetic scene, written in the D-NeRF layout together with its true motion.

The scene is monocular like D-NeRF: each training frame has its own time and its own camera. Consecutive cameras
surround the figure, so that no side of it is unseen for long: cameras drawn at random leave its face unseen for a tenth
of the motion. Test frames are spread over time and have other cameras, drawn at random from the upper hemisphere. The
same arguments give the same bytes.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import UserError
from ...storage.files import read_text
from ...storage.json_files import parse_json
from ...storage.output_folders import paths_in, write_folder_atomically
from .figure import build_figure
from .figure_motion import bone_transforms
from .orbit_cameras import PlannedPicture, instants, random_on_sphere, surrounding
from .raycast import Raycaster
from .renderer import SURFACE_POINTS, Optics, pick_on_triangles, write_pictures
from .shading import Shading
from .surface import PartMesh, RigidParts

VERSION = 5
"""Version of the pictures and the ground truth; folders with another version are replaced."""
MARKER = "synthetic.json"
RADIUS = 4.0311
FIELD_OF_VIEW = 0.6911112070083618
"""Horizontal field of view in radians: ``camera_angle_x`` of D-NeRF."""
SINE_OF_ELEVATION = (0.05, 0.85)
SAMPLES = 4
"""Number of rays per pixel along each axis."""


def make_synthetic(
    folder: str | Path,
    size: int = 400,
    train: int = 100,
    test: int = 20,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    device: str = "cpu",
) -> Path:
    """Make the scene in ``folder``, unless the folder already holds it with these arguments.

    An interrupted call leaves no incomplete folder (``write_folder_atomically``).

    Args:
        size: width and height in pixels.
        train: number of training frames, each with its own camera.
        test: number of held-out frames, each with its own camera.
        seed: seed of the cameras and of the surface points.
        progress: called with (done, total) after each picture.
        device: device of the ray casting, ``cpu`` or ``cuda``.

    Returns:
        The folder, with ``transforms_{train,test}.json``, ``train/``, ``test/``, ``ground_truth.npz`` and
        ``synthetic.json``.

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
    write_folder_atomically(folder, lambda work: _write_scene(work, recipe, progress, device))
    return folder


def _recipe_of(folder: Path) -> dict[str, Any] | None:
    try:
        return parse_json(read_text(folder / MARKER))
    except (OSError, ValueError):
        return None


def _check_replaceable(folder: Path) -> None:
    """Refuse to replace anything but a synthetic scene or an empty folder."""
    if not folder.exists() or (folder.is_dir() and (_recipe_of(folder) is not None or not paths_in(folder))):
        return
    raise UserError(f"{folder}: exists and holds no synthetic scene ({MARKER}); give another folder, or remove it")


class FigureSubject:
    """The built-in figure as a ``Subject`` of the renderer."""

    def __init__(self, device: str = "cpu", shading: Shading | None = None) -> None:
        self.device = device
        self.figure = build_figure()
        self.surface = RigidParts(self.figure, bone_transforms)
        self.raycaster = Raycaster(self.surface, device, shading)
        self.pose, self.render, self.visible = self.raycaster.pose, self.raycaster.render, self.raycaster.visible

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Sample surface points: for each, its part and its position in the frame of the part's bone (see
        ``sample_surface``)."""
        return sample_surface(self.figure, count, rng)

    def track(self, points: tuple[np.ndarray, np.ndarray], times: Sequence[float]) -> np.ndarray:
        """Return world positions [T, P, 3] float64 of surface points."""
        part, local = points
        tracks = []
        for time in times:
            transforms = self.surface.part_transforms(float(time))[part]
            tracks.append(np.einsum("pij,pj->pi", transforms[:, :3, :3], local) + transforms[:, :3, 3])
        return np.stack(tracks)


def _write_scene(work: Path, recipe: dict[str, Any], progress: Callable[[int, int], None] | None, device: str) -> None:
    subject = FigureSubject(device)
    rng = np.random.default_rng(recipe["seed"])
    points = subject.sample(SURFACE_POINTS, rng)
    start = float(rng.uniform(0.0, 2.0 * math.pi))
    cameras = {
        "train": surrounding(recipe["train"], SINE_OF_ELEVATION, RADIUS, start),
        "test": [random_camera(rng) for _ in range(recipe["test"])],
    }
    pictures = {
        split: [PlannedPicture(time, camera, 0) for time, camera in zip(instants(len(own)), own)]
        for split, own in cameras.items()
    }
    total = recipe["train"] + recipe["test"]
    counter = itertools.count(1)

    def done() -> None:
        if progress is not None:
            progress(next(counter), total)

    optics = Optics(FIELD_OF_VIEW, recipe["size"], recipe["size"], SAMPLES)
    write_pictures(work, subject, points, pictures, optics, done)
    (work / MARKER).write_text(json.dumps(recipe) + "\n", encoding="utf-8")


def random_camera(rng: np.random.Generator) -> np.ndarray:
    """Draw a camera-to-world matrix [4, 4], OpenGL: uniform on the upper hemisphere, facing the origin."""
    return random_on_sphere(rng, SINE_OF_ELEVATION, RADIUS)


def sample_surface(figure: PartMesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Sample points evenly by area over all parts: return the part [P], and the position in its bone's frame [P, 3].

    Some points lie inside a neighbouring part; these are never visible.
    """
    face, u, v = pick_on_triangles(figure.local[figure.faces], count, rng)
    a, b, c = figure.local[figure.faces[face]].transpose(1, 0, 2)
    return figure.face_part[face], a + u * (b - a) + v * (c - a)
