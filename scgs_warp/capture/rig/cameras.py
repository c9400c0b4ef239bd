"""Cameras of a rig: COLMAP's mapping of one picture per camera, in which nothing moves."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..bundle_adjustment import adjust
from ..colmap import database_errors, quiet, read_model, write_model
from ..features import FrameFiles
from ..mapping import MAX_ERROR

MIN_VIEWS = 2
"""Smallest number of cameras in which a point must be seen; rigs have few."""
FEW_INLIERS = (100, 50, 25)
"""Smallest numbers of matches of the first pair of cameras, tried one after the other: cameras of a rig stand far
apart."""

LENS_GAIN = 0.01
"""Least share by which distortion must lower the median reprojection error. A few pictures can hardly tell distortion
from focal length, and a distortion that explains next to nothing bends the scene."""


class RigCamera(NamedTuple):
    """A camera that stands still."""

    model: str
    """COLMAP's name of the camera model."""
    params: tuple[float, ...]
    width: int
    height: int
    viewmat: np.ndarray
    """[4, 4] world-to-camera, OpenCV."""


class RigSolution(NamedTuple):
    """Cameras and static points, in COLMAP's arbitrary frame and scale."""

    cameras: dict[int, RigCamera]
    """By the number of the camera."""
    points: np.ndarray
    """[P, 3]"""
    colors: np.ndarray
    """[P, 3] uint8"""
    error: float
    """Mean reprojection error, pixels."""


def solve(database: Path, stills: FrameFiles, folder: Path, seed: int) -> int:
    """Run the mapper on one picture per camera, and write its largest model to ``folder``.

    Returns:
        Number of cameras found; 0 without a model.

    Raises:
        UserError: the model cannot be written.
    """
    attempts = folder.with_name(f"{folder.name}-attempts")
    best, most = None, 0
    with quiet() as pycolmap, database_errors(database):
        for inliers in FEW_INLIERS:
            shutil.rmtree(attempts, ignore_errors=True)
            attempts.mkdir(parents=True)
            options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed, min_model_size=2)
            options.mapper.num_threads = 1
            options.mapper.random_seed = seed
            options.mapper.init_min_num_inliers = inliers
            options.mapper.abs_pose_min_num_inliers = max(12, inliers // 4)
            options.triangulation.random_seed = seed
            options.triangulation.ignore_two_view_tracks = False
            pycolmap.set_random_seed(seed)
            models = pycolmap.incremental_mapping(database, stills.folder, attempts, options)
            found = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)
            if found is not None and found.num_reg_images() > most:
                best, most = found, found.num_reg_images()
            if most == len(stills.names):
                break
        shutil.rmtree(attempts, ignore_errors=True)
        if best is not None:
            write_model(straightened(best), folder)
    return most


def straightened(model: Any) -> Any:
    """Return a COLMAP reconstruction adjusted anew, with lenses without distortion if these fit almost as well."""
    if not model.points3D:
        return model
    if not any(len(lens.extra_params_idxs()) for lens in model.cameras.values()):
        straight = copy.deepcopy(model)
        adjust(straight, distortion=False)
        return straight
    bent, straight = copy.deepcopy(model), copy.deepcopy(model)
    for lens in straight.cameras.values():
        params = np.array(lens.params)
        params[lens.extra_params_idxs()] = 0.0
        lens.params = params
    errors = [adjust(bent, distortion=True), adjust(straight, distortion=False)]
    return straight if errors[1] * (1.0 - LENS_GAIN) <= errors[0] else bent


def read_solution(folder: Path, names: Sequence[str]) -> RigSolution | None:
    """Read the model written by :func:`solve`; return None without a model, raise UserError if it is damaged."""
    if not (folder / "images.bin").is_file():
        return None
    model = read_model(folder)
    with quiet():
        return solution_of(model, names)


def solution_of(model: Any, names: Sequence[str]) -> RigSolution:
    """Return the cameras and points of a COLMAP reconstruction."""
    numbers = {name: number for number, name in enumerate(names)}
    cameras = {}
    for image in model.images.values():
        if not image.has_pose:
            continue
        viewmat = np.eye(4)
        viewmat[:3] = image.cam_from_world().matrix()
        lens = model.cameras[image.camera_id]
        params = tuple(float(value) for value in lens.params)
        cameras[numbers[image.name]] = RigCamera(lens.model_name, params, lens.width, lens.height, viewmat)
    points = [model.points3D[key] for key in sorted(model.points3D)]
    kept = [p for p in points if p.track.length() >= MIN_VIEWS and p.error <= MAX_ERROR]
    return RigSolution(
        dict(sorted(cameras.items())),
        np.array([point.xyz for point in kept], np.float64).reshape(-1, 3),
        np.array([point.color for point in kept], np.uint8).reshape(-1, 3),
        float(model.compute_mean_reprojection_error()),
    )


def centre_of(viewmat: np.ndarray) -> np.ndarray:
    """Return the position [3] of a camera."""
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


def pairs_of(count: int) -> list[tuple[int, int]]:
    """Return all pairs of cameras."""
    return [(a, b) for a in range(count) for b in range(a + 1, count)]
