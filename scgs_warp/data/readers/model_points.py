"""Points of the COLMAP model from which another layout's cameras were made: older versions of nerfstudio keep the model
in ``colmap/sparse/0``, turn the world of the cameras, and write no file of points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from ...errors import UserError
from ...geometry.rotation import is_rotation
from .colmap_model import ModelImage, find_model, read_model

FEWEST = 3
"""Smallest number of cameras in common."""
TOLERANCE = 1e-3
"""Largest difference between cameras of the two worlds: of entries of their rotations, and of their places as a share
of the places' extent."""


class ModelPoints(NamedTuple):
    points: np.ndarray
    """[P, 3] in the world of the cameras."""
    colors: np.ndarray
    """[P, 3] in [0, 1]"""


def points_of_model(folder: Path, names: Sequence[str], viewmats: Sequence[np.ndarray]) -> ModelPoints | None:
    """Return the points of the model in ``folder``, moved to the world of the cameras; None without a sound model whose
    cameras are these but for a rotation, a scale and a translation.

    Args:
        names: file name of each camera's image.
        viewmats: [4, 4] world-to-camera, OpenCV, of each.
    """
    place = find_model(folder)
    if place is None:
        return None
    try:
        model = read_model(place)
    except UserError:  # the cameras do not need it
        return None
    pairs = _pairs(model.images, names, viewmats)
    with np.errstate(all="ignore"):  # places too far away fit nothing
        found = _between(*pairs) if pairs is not None and len(model.points) else None
    if found is None:
        return None
    scale, rotation, shift = found
    return ModelPoints(scale * model.points @ rotation.T + shift, model.colors)


def _pairs(
    images: list[ModelImage], names: Sequence[str], viewmats: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the model's and the other world-to-camera matrices [C, 4, 4] of the cameras whose images have one name;
    None if they are too few, or if names are not unique."""
    of_model = {PurePosixPath(image.name).name: image.viewmat for image in images}
    if len(of_model) != len(images) or len(set(names)) != len(names):
        return None
    both = [(of_model[name], viewmat) for name, viewmat in zip(names, viewmats) if name in of_model]
    if len(both) < FEWEST:
        return None
    return np.stack([one for one, _ in both]), np.stack([two for _, two in both])


def _between(model: np.ndarray, other: np.ndarray) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Return scale, rotation [3, 3] and translation [3] from the world of the ``model`` cameras [C, 4, 4] to that of
    the ``other`` ones; None if nothing fits all of them."""
    turns = np.swapaxes(other[:, :3, :3], 1, 2) @ model[:, :3, :3]
    u, _, vt = np.linalg.svd(turns.mean(axis=0))
    rotation = u @ vt
    starts, ends = (-np.einsum("cij,ci->cj", each[:, :3, :3], each[:, :3, 3]) for each in (model, other))
    start, end = starts.mean(axis=0), ends.mean(axis=0)
    away, to = (starts - start) @ rotation.T, ends - end
    extent, norm = float(np.abs(to).max()), float((away**2).sum())
    if not is_rotation(rotation) or np.abs(turns - rotation).max() > TOLERANCE or not (extent > 0.0 and norm > 0.0):
        return None
    scale = float((away * to).sum()) / norm
    if not scale > 0.0 or np.abs(scale * away - to).max() > TOLERANCE * extent:
        return None
    return scale, rotation, end - scale * rotation @ start
