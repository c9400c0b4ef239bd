"""Camera poses from COLMAP's incremental mapping of matched frames; only the largest model is kept."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .colmap import database_errors, quiet, read_model, write_model
from .diagnosis import MAX_PLANAR
from .features import FrameFiles, links

MIN_VIEWS = 3
"""Smallest number of frames in which a point must be seen."""
MAX_ERROR = 2.0
"""Largest mean reprojection error of a point, pixels."""
FEW = 0.5
"""Share of frames with a camera below which the mapper begins once more, with less parallax."""
LITTLE_PARALLAX = 4.0
"""Least angle, degrees, between the rays to the points of the two frames with which it begins then; COLMAP's is 16."""


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

    The mapper runs on one thread, because sums over threads would differ from run to run. If few frames get a camera
    although their matches show parallax, it runs once more and begins with less: a camera that goes straight ahead
    sees surfaces from nearly the same side for long.

    Args:
        done: called after each registered frame.

    Returns:
        Number of frames registered in the largest model; 0 without a model.

    Raises:
        UserError: the model cannot be written.
    """
    best = _largest_model(database, frame_files, folder, seed, done)
    few = FEW * len(frame_files.names)
    if _registered(best) < few and links(database, frame_files).planar <= MAX_PLANAR:
        other = _largest_model(database, frame_files, folder, seed, done, LITTLE_PARALLAX)
        best = max(best, other, key=_registered)
    if _registered(best):
        write_model(best, folder)
    return _registered(best)


def _largest_model(
    database: Path,
    frame_files: FrameFiles,
    folder: Path,
    seed: int,
    done: Callable[[], object],
    parallax: float | None = None,
) -> Any:
    """Run the mapper and return its largest model, or None.

    Args:
        parallax: least angle, degrees, between the rays to the points of the first two frames, which may then also lie
            one straight ahead of the other; None: as COLMAP requires.
    """
    attempts = folder.with_name(f"{folder.name}-attempts")
    shutil.rmtree(attempts, ignore_errors=True)
    attempts.mkdir(parents=True)
    with quiet() as pycolmap, database_errors(database):
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed, min_model_size=3)
        options.mapper.num_threads = 1
        options.mapper.random_seed = seed
        options.triangulation.random_seed = seed
        if parallax is not None:
            options.mapper.init_min_tri_angle, options.mapper.init_max_forward_motion = parallax, 1.0
        pycolmap.set_random_seed(seed)
        models = pycolmap.incremental_mapping(
            database, frame_files.folder, attempts, options, next_image_callback=lambda: _ignore(done())
        )
    shutil.rmtree(attempts, ignore_errors=True)
    return max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def _registered(model: Any) -> int:
    """Return the number of frames of a model that have a camera; 0 without a model."""
    return 0 if model is None else model.num_reg_images()


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
