"""What an importer finds: frames with cameras, and depth where there is any."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import UserError
from ...geometry.rotation import OPENGL_TO_OPENCV, is_rotation

MAX_NUMBER = 1e9
"""Largest magnitude of a number in a pose or an intrinsic, and largest depth."""
MIN_FOCAL = 1e-3
"""Smallest focal length, pixels."""
UNSURE = 0.2
"""Share of the pixels of a frame whose depth is left out where a network states its confidence: the least sure ones."""
NEAR_ROTATION = 0.02
"""Largest distance of a matrix from its nearest rotation that is attributed to rounding."""

Y_UP_TO_Z_UP = np.array([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""World of ARKit (y up) to ours (z up)."""


@dataclass(frozen=True)
class ImportedFrame:
    """A frame of another program."""

    image: Path | Callable[[], np.ndarray]
    """A file of the picture, or a function that returns it, [H, W, 3] uint8 RGB."""
    viewmat: np.ndarray
    """[4, 4] world-to-camera, OpenCV."""
    K: np.ndarray
    """[3, 3] in pixels of the image."""
    moment: float
    """In any unit."""
    depth: Callable[[], np.ndarray] | None = None
    """Function that returns the depth along the optical axis, [h, w], of any size; 0 or not finite where unknown."""


@dataclass(frozen=True)
class ImportedScene:
    """All frames, in the order of time."""

    program: str
    """What the layout is called."""
    frames: list[ImportedFrame]
    gravity: bool
    """True if the world is metric with z up; otherwise it has any orientation and scale."""
    note: str | None = None
    """Line about what was left out."""


def rigid(matrix: np.ndarray, where: str) -> np.ndarray:
    """Return a pose [4, 4] with an exact rotation.

    Args:
        matrix: [3, 4] or [4, 4] numbers.
        where: file and field, for the message.

    Raises:
        UserError: it is not finite or not rigid.
    """
    pose = np.eye(4)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all() or np.abs(matrix).max() > MAX_NUMBER:
        raise UserError(f"{where} is no finite matrix of 3 or 4 rows of 4 numbers; export the scene again")
    pose[:3] = matrix[:3]
    u, _, vt = np.linalg.svd(pose[:3, :3])
    nearest = u @ vt
    if np.abs(nearest - pose[:3, :3]).max() > NEAR_ROTATION or not is_rotation(nearest):
        raise UserError(f"{where} is not rigid (scaled, sheared or mirrored); export the scene again")
    pose[:3, :3] = nearest
    return pose


def intrinsics(values: np.ndarray, where: str) -> np.ndarray:
    """Check a matrix K [3, 3] with positive focal lengths, in pixels.

    Raises:
        UserError: it is none.
    """
    good = values.shape == (3, 3) and np.isfinite(values).all() and np.abs(values).max() < MAX_NUMBER
    if not good or min(values[0, 0], values[1, 1]) < MIN_FOCAL:
        raise UserError(f"{where} is no matrix of 3 x 3 numbers with positive focal lengths; export the scene again")
    return np.array([[values[0, 0], 0.0, values[0, 2]], [0.0, values[1, 1], values[1, 2]], [0.0, 0.0, 1.0]])


def surer(depth: np.ndarray, confidence: np.ndarray, where: str) -> np.ndarray:
    """Return the depth [h, w] with 0 where the confidence [h, w] is among the lowest ``UNSURE``.

    Raises:
        UserError: the shapes differ.
    """
    if confidence.shape != depth.shape:
        raise UserError(
            f"{where} is {list(confidence.shape)}, but the depth {list(depth.shape)}; export the scene again"
        )
    known = np.isfinite(confidence)
    if not known.any():
        return depth
    return np.where(known & (confidence >= np.quantile(confidence[known], UNSURE)), depth, 0.0)


def from_arkit(camera_to_world: np.ndarray) -> np.ndarray:
    """Return the world-to-camera matrix, OpenCV and z up, of a rigid pose of ARKit (OpenGL axes, y up)."""
    return np.linalg.inv(Y_UP_TO_Z_UP @ camera_to_world @ OPENGL_TO_OPENCV)
