"""Contact sheet of a synthetic data set: training pictures, their true surface points, and held-out pictures."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from ...types import Camera
from ..dataset import spread
from .orbit_cameras import PlannedPicture
from .renderer import over_gray

COLUMNS = 6
CELL = 240
"""Largest width of a picture on the sheet, pixels."""
GAP = 4
GROUND = 0.85
"""Grey level behind transparent pixels."""
DOT = 1


class ContactSheet:
    """A ``Watcher`` that collects some of the pictures while they are made."""

    def __init__(self, counts: dict[str, int]) -> None:
        """
        Args:
            counts: number of pictures of each split.
        """
        self._wanted = {split: set(spread(count, COLUMNS)) for split, count in counts.items() if split != "val"}
        self._rows: dict[str, list[np.ndarray]] = {"train": [], "tracks": [], "test": []}
        self._colors: np.ndarray | None = None

    def __call__(
        self, split: str, index: int, planned: PlannedPicture, camera: Camera, image: np.ndarray, seen: Any
    ) -> None:
        if seen is not None and self._colors is None:
            self._colors = position_hues(seen[0])
        if index not in self._wanted.get(split, ()):
            return
        picture = np.rint(over_gray(image, GROUND).clip(0.0, 1.0) * 255.0).astype(np.uint8)
        caption = f"{split} {index}  t {planned.time:.2f}"
        self._rows[split].append(_captioned(_reduced(picture), caption))
        if seen is not None and self._colors is not None:
            points, visible = seen
            self._rows["tracks"].append(_captioned(self._dotted(picture, camera, points, visible), "visible points"))

    def _dotted(self, picture: np.ndarray, camera: Camera, points: np.ndarray, visible: np.ndarray) -> np.ndarray:
        """Fade the picture and draw a dot at each visible surface point; each point has the same colour at all
        times."""
        assert self._colors is not None
        reduced = _reduced((0.4 * picture + 0.6 * 255 * GROUND).astype(np.uint8))
        pixels = project(camera, points[visible]) * (reduced.shape[1] / picture.shape[1])
        for (x, y), color in zip(np.floor(pixels).astype(int).tolist(), self._colors[visible].tolist()):
            cv2.circle(reduced, (x, y), DOT, color, -1)
        return reduced

    def draw(self) -> np.ndarray:
        """Draw the sheet, [height, width, 3] uint8 RGB."""
        rows = [row for row in self._rows.values() if row]
        height, width = rows[0][0].shape[:2]
        columns = max(len(row) for row in rows)
        shape = (GAP + len(rows) * (height + GAP), GAP + columns * (width + GAP), 3)
        sheet = np.full(shape, 255, np.uint8)
        for r, row in enumerate(rows):
            for c, picture in enumerate(row):
                top, left = GAP + r * (height + GAP), GAP + c * (width + GAP)
                sheet[top : top + height, left : left + width] = picture
        return sheet


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Project world points [P, 3] to pixels [P, 2]."""
    viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    seen = (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
    return seen[:, :2] / seen[:, 2:]


def position_hues(points: np.ndarray) -> np.ndarray:
    """Map positions [P, 3] to RGB bytes [P, 3]."""
    low, high = points.min(0), points.max(0)
    return np.rint(255.0 * (points - low) / np.maximum(high - low, 1e-9)).astype(np.uint8)


def _reduced(picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    if width <= CELL:
        return picture.copy()
    return cv2.resize(picture, (CELL, max(1, round(height * CELL / width))), interpolation=cv2.INTER_AREA)


def _captioned(picture: np.ndarray, text: str) -> np.ndarray:
    if picture.shape[1] >= 120:
        cv2.putText(picture, text, (5, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (40, 40, 40), 1, cv2.LINE_AA)
    return picture
