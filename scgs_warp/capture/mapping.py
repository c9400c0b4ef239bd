"""Camera poses from COLMAP's incremental mapping of matched frames; only the largest model is kept."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .colmap import database_errors, quiet, read_model, write_model
from .features import FrameFiles

MIN_VIEWS = 3
"""Smallest number of frames in which a point must be seen."""
MAX_ERROR = 2.0
"""Largest mean reprojection error of a point, pixels."""


class CameraSolution(NamedTuple):
    """Cameras and points of the static scene, in COLMAP's arbitrary frame and scale."""

    model: str
    """COLMAP's name of the camera model."""
    params: tuple[float, ...]
    width: int
    height: int
    places: list[int]
    """Indices of the registered frames, ascending."""
    viewmats: np.ndarray
    """[V, 4, 4] world-to-camera, OpenCV."""
    points: np.ndarray
    """[P, 3] points seen in several frames."""
    colors: np.ndarray
    """[P, 3] uint8"""
    error: float
    """Mean reprojection error, pixels."""
    arc: float
    """Median angle between the rays to a point, degrees."""


def solve(database: Path, frame_files: FrameFiles, folder: Path, seed: int, done: Callable[[], object]) -> int:
    """Run the mapper and write its largest model to ``folder``.

    The mapper runs on one thread, because sums over threads would differ from run to run.

    Args:
        done: called after each registered frame.

    Returns:
        Number of frames registered in the largest model; 0 without a model.

    Raises:
        UserError: the model cannot be written.
    """
    attempts = folder.with_name(f"{folder.name}-attempts")
    shutil.rmtree(attempts, ignore_errors=True)
    attempts.mkdir(parents=True)
    with quiet() as pycolmap, database_errors(database):
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed, min_model_size=3)
        options.mapper.num_threads = 1
        options.mapper.random_seed = seed
        options.triangulation.random_seed = seed
        pycolmap.set_random_seed(seed)
        models = pycolmap.incremental_mapping(
            database, frame_files.folder, attempts, options, next_image_callback=lambda: _ignore(done())
        )
        best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)
        if best is not None and best.num_reg_images():
            write_model(best, folder)
    shutil.rmtree(attempts, ignore_errors=True)
    return 0 if best is None else best.num_reg_images()


def _ignore(_: object) -> None:
    """Discard a result. The mapper requires a callback that returns None."""


def read_solution(folder: Path, frame_files: FrameFiles) -> CameraSolution | None:
    """Read the model written by :func:`solve`; return None without a model, raise UserError if it is damaged."""
    if not (folder / "images.bin").is_file():
        return None
    model = read_model(folder)
    with quiet():
        numbers = {name: number for number, name in enumerate(frame_files.names)}
        images = {numbers[image.name]: image for image in model.images.values() if image.has_pose}
        places = sorted(images)
        viewmats = np.tile(np.eye(4), (len(places), 1, 1))
        for row, number in enumerate(places):
            viewmats[row, :3] = images[number].cam_from_world().matrix()
        camera = next(iter(model.cameras.values()))
        points = [model.points3D[key] for key in sorted(model.points3D)]
        kept = [p for p in points if p.track.length() >= MIN_VIEWS and p.error <= MAX_ERROR] or points
        return CameraSolution(
            camera.model_name,
            tuple(float(value) for value in camera.params),
            camera.width,
            camera.height,
            places,
            viewmats,
            np.array([point.xyz for point in kept], np.float64).reshape(-1, 3),
            np.array([point.color for point in kept], np.uint8).reshape(-1, 3),
            float(model.compute_mean_reprojection_error()),
            _arc(model, points),
        )


def _arc(model, points: list) -> float:
    """Return the median over points of the angle, in degrees, between the rays from the first and the last camera that
    see the point."""
    centres = {key: image.projection_center() for key, image in model.images.items() if image.has_pose}
    angles = []
    for point in points[:: max(1, len(points) // 2000)]:
        seen = sorted(element.image_id for element in point.track.elements)
        a, b = (centres[key] - point.xyz for key in (seen[0], seen[-1]))
        cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-18)
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return float(np.median(angles)) if angles else 0.0
