"""Depth maps of an import as files: ``depths/frame_00000.npy``, which ``transforms.json`` names."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ...data.depth_maps import has_proportions
from ...errors import UserError
from .scene import MAX_NUMBER

FOLDER = "depths"
LONGEST = 512
"""Longer side to which maps are reduced, pixels; training compares depth at half of it."""
LARGEST = 6e4
"""Largest value written, in the unit of the file: float16 ends there."""


class DepthWriter:
    """Writes depth along z as float16 in units of the first map's median, so that any scale of the world fits."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / FOLDER
        self.unit = 0.0
        """Unit of the files, in that of the depth; 0 before the first map with known depth."""

    def write(self, stem: str, depth: np.ndarray, image: tuple[int, int]) -> str | None:
        """Write a map [h, w], 0 or not finite where unknown.

        Args:
            image: (width, height) of its image.

        Returns:
            Name in the data set; None if all of the map is unknown, or it has other proportions than the image.
        """
        if not has_proportions((depth.shape[1], depth.shape[0]), image):
            return None
        factor = min(1.0, LONGEST / max(depth.shape))
        size = max(1, round(depth.shape[1] * factor)), max(1, round(depth.shape[0] * factor))
        taken = cv2.resize(known_depth(depth), size, interpolation=cv2.INTER_NEAREST_EXACT)
        if not (taken > 0).any():
            return None
        if not self.unit:
            self.unit = float(np.median(taken[taken > 0]))
            self._folder.mkdir()
        values = taken / self.unit
        np.save(self._folder / f"{stem}.npy", np.where(values < LARGEST, values, 0.0).astype(np.float16))
        return f"{FOLDER}/{stem}.npy"


def known_depth(depth: np.ndarray) -> np.ndarray:
    """Return a depth map [h, w] float64 with 0 wherever it is unknown or beyond any number in use."""
    depth = depth.astype(np.float64)
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(depth) & (depth > 0) & (depth < MAX_NUMBER), depth, 0.0)


def checked_depth(depth: np.ndarray, where: str) -> np.ndarray:
    """Return a depth map.

    Args:
        where: frame, for the message.

    Raises:
        UserError: it is not [h, w].
    """
    if depth.ndim != 2 or min(depth.shape) < 2:
        raise UserError(f"{where}: its depth is {list(depth.shape)}, not [h, w]; export the scene again")
    return depth
