"""Lenses of a rig whose cameras record pictures of one size but may have different lenses, as phones of several makes
do."""

from __future__ import annotations

import copy
import os
import shutil
from pathlib import Path

from .. import features
from ..bundle_adjustment import median_error
from ..colmap import opened, quiet, read_model, remove_database
from ..features import CameraModel, FrameFiles
from . import cameras

FEWEST = 3
"""Smallest number of cameras whose matches tell fields of view apart."""
GAIN = 1.15
"""Least factor by which lenses of their own must lower the median reprojection error."""
DIFFERENT = 1.02
"""Least ratio between the focal lengths of different lenses; those of one lens are found alike within less."""


def prefer_own_lenses(
    database: Path, stills: FrameFiles, folder: Path, model: CameraModel, focal: float | None, seed: int, device: str
) -> None:
    """Find the cameras once more with a lens for each, and replace the model in ``folder`` if its shared lens fits
    clearly worse.

    Args:
        database: features of the still pictures, with a shared lens.
        model: COLMAP's camera model.
        focal: initial focal length in pixels; None if unknown.

    Raises:
        UserError: a file cannot be written.
    """
    count = len(stills.names)
    if count < FEWEST:
        return
    other, attempt = database.with_name("database-lenses.db"), folder.with_name(f"{folder.name}-lenses")
    remove_database(other)
    shutil.rmtree(attempt, ignore_errors=True)
    try:
        features.begin(other, stills, model, focal, shared=False)
        _copy_features(database, other, stills)
        features.match(other, stills, cameras.pairs_of(count), seed, device, lambda: None)
        if cameras.solve(other, stills, attempt, seed) and _fits_better(attempt, folder):
            shutil.rmtree(folder, ignore_errors=True)
            os.replace(attempt, folder)
    finally:
        remove_database(other)
        shutil.rmtree(attempt, ignore_errors=True)


def _copy_features(source: Path, target: Path, stills: FrameFiles) -> None:
    with opened(source) as (_, one), opened(target) as (_, two):
        for name in stills.names:
            images = [storage.read_image_with_name(name).image_id for storage in (one, two)]
            two.write_descriptors(images[1], one.read_descriptors(images[0]))
            two.write_keypoints(images[1], one.read_keypoints(images[0]))


def _fits_better(attempt: Path, folder: Path) -> bool:
    """Return whether a model whose cameras have lenses of their own is better than the one of a shared lens."""
    if not (folder / "images.bin").is_file():
        return True
    own, shared = read_model(attempt), read_model(folder)
    if own.num_reg_images() != shared.num_reg_images():
        return own.num_reg_images() > shared.num_reg_images()
    focals = [float(lens.mean_focal_length()) for lens in own.cameras.values()]
    with quiet():
        errors = [median_error(copy.deepcopy(each)) for each in (own, shared)]
    return max(focals) > DIFFERENT * min(focals) and errors[1] > GAIN * errors[0]


def describe_lenses(solved: cameras.RigSolution) -> list[str]:
    """Say that cameras with pictures of one size turned out to have lenses of their own."""
    focals = [camera.params[0] for camera in solved.cameras.values()]
    if len({(camera.width, camera.height) for camera in solved.cameras.values()}) > 1 or len(set(focals)) == 1:
        return []
    return [f"each camera has a lens of its own: their focal lengths are {min(focals):.0f} to {max(focals):.0f} pixels"]
