"""Training views beside the rendered depth, in which points of the scene are looked up."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np


def project(viewmat: np.ndarray, K: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project points [..., 3] by a camera [4, 4] and [3, 3]; return columns, rows (0 is the centre of the first pixel)
    and depths, [...] each. Points behind the camera get a depth of 1e-6."""
    x, y, depth = np.moveaxis(points @ viewmat[:3, :3].T + viewmat[:3, 3], -1, 0)
    depth = np.maximum(depth, 1e-6)
    return K[0, 0] * x / depth + K[0, 2] - 0.5, K[1, 1] * y / depth + K[1, 2] - 0.5, depth


class Views(NamedTuple):
    """The training views, ordered by instant."""

    instants: np.ndarray
    """[V] instant of each view."""
    viewmats: np.ndarray
    """[V, 4, 4] world-to-camera, normalised."""
    intrinsics: np.ndarray
    """[V, 3, 3] for the pixels of ``colors``."""
    colors: list[np.ndarray]
    """[H, W, 3] float32 of each view, slightly blurred, free of the background."""
    depths: list[np.ndarray]
    """[H, W] float32 rendered depth of each view, normalised; infinite where nothing is."""

    @property
    def count(self) -> int:
        """Number of instants."""
        return int(self.instants[-1]) + 1

    def within(self, start: int, length: int) -> range:
        """Return the views of ``length`` instants from ``start`` on."""
        first, last = np.searchsorted(self.instants, (start, start + length))
        return range(int(first), int(last))

    def eye(self, view: int) -> np.ndarray:
        """Return the centre of projection, [3]."""
        viewmat = self.viewmats[view]
        return -viewmat[:3, :3].T @ viewmat[:3, 3]

    def project(self, view: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project points [..., 3] into a view (:func:`project`)."""
        return project(self.viewmats[view], self.intrinsics[view], points)

    def color_at(self, view: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the colours [H, n, 3] at columns and rows [H, n], between pixels by linear interpolation."""
        at = x.astype(np.float32), y.astype(np.float32)
        found = cv2.remap(self.colors[view], *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return found.reshape(*x.shape, 3).astype(np.float64)

    def depth_at(self, view: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the rendered depth of the nearest pixel, [...]; -inf outside the image and where nothing is."""
        depth = self.depths[view]
        height, width = depth.shape
        column, row = np.rint(x).astype(int), np.rint(y).astype(int)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        found = depth[row.clip(0, height - 1), column.clip(0, width - 1)]
        return np.where(inside & np.isfinite(found), found, -np.inf)
