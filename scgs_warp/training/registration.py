"""Places of moving points by comparing an image with the one in which they were seen first.

A track from moment to moment drifts, and is less sure after each step. Where an image far away in time shows a point
again, the two images say where it is, without the steps between. The expected places of all points warp the far image
to the near one; what then differs is small enough for optical flow.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..data.dataset import Dataset
from ..geometry.optical_flow import at_targets, dense_flow, returns, targets_of, textured
from ..geometry.pinhole import pixels_of
from ..runtime.search_tree import search_tree
from .clouds import Cloud
from .depth import FrameDepths
from .flow import ROUND_TRIP, Flows, gray_at

SAME_DEPTH = 0.06
"""Largest relative difference between the expected depth of a point and that of the image, if the image shows it."""
FEWEST = 32
"""Least number of points that an image shows."""
AROUND, REACH = 4, 3.0
"""Number of points from whose displacements that of a pixel is interpolated, and the distance of the nearest one in
pixels, up to which it is."""
BESIDE = 24
"""Width of the margin around the points in which images are compared, pixels."""
FARTHEST = 0.05
"""Largest distance of a place from the expected one, as a share of the longer side."""


class Registration:
    """Comparison of the frames that clouds are of."""

    def __init__(
        self, data: Dataset, flows: Flows, depths: FrameDepths, frame_then: Callable[[int, float], int | None]
    ) -> None:
        """
        Args:
            frame_then: returns the frame of the same camera at the time of another cloud; None if it has no depth.
        """
        self._data, self._flows, self._depths, self._frame_then = data, flows, depths, frame_then
        self._grays: dict[int, np.ndarray] = {}

    def places(self, cloud: Cloud, time: float, expected: np.ndarray) -> np.ndarray:
        """Return where the points of a cloud are at the time of another, [P, 3]; NaN where no image shows it.

        Args:
            expected: [P, 3] about where they are.
        """
        assert cloud.frames is not None and cloud.pixels is not None, "clouds of films only"
        there, frames = np.full(expected.shape, np.nan), cloud.frames.numpy()
        for frame in np.unique(frames).tolist():
            other = self._frame_then(frame, time)
            own = (frames == frame).nonzero()[0]
            if other is not None and other != frame:
                there[own] = self._compared(frame, other, cloud.pixels.numpy()[own], expected[own])
        return there

    def _compared(self, one: int, two: int, pixels: np.ndarray, expected: np.ndarray) -> np.ndarray:
        """Find points [P, 3], seen at pixels [P, 2] of frame ``one``, in frame ``two``."""
        there, seen = np.full(expected.shape, np.nan), self._depths.of(two)
        if seen is None:
            return there
        inverse = seen.inverse.numpy()
        height, width = inverse.shape
        at, depth = pixels_of(seen.camera, expected)
        shown = np.abs(depth * _sampled(inverse, at) - 1.0) < SAME_DEPTH
        if shown.sum() < FEWEST:
            return there
        near, far = self._gray(one), self._gray(two)
        low = np.maximum(pixels[shown].min(0) - BESIDE, 0).astype(int)
        high = np.minimum(pixels[shown].max(0) + BESIDE + 1, [width, height]).astype(int)
        near = np.ascontiguousarray(near[low[1] : high[1], low[0] : high[0]])
        warp, known = _interpolated(pixels[shown] - low, at[shown] - pixels[shown], near.shape)
        corner = low.astype(np.float32)
        warped = np.where(known, at_targets(far, targets_of(warp) + corner), near)
        rest = dense_flow(near, warped)
        sure = returns(rest, dense_flow(warped, near), ROUND_TRIP * max(height, width)) & textured(near) & known
        targets = targets_of(rest + at_targets(warp, targets_of(rest))) + corner
        sure &= np.linalg.norm(rest, axis=2) < FARTHEST * max(height, width)
        columns, rows = (pixels - low).astype(int).T
        inside = (columns >= 0) & (rows >= 0) & (columns < near.shape[1]) & (rows < near.shape[0])
        columns, rows = columns.clip(0, near.shape[1] - 1), rows.clip(0, near.shape[0] - 1)
        found = targets[rows, columns].astype(np.float64)
        there_inverse = _sampled(inverse, found)
        good = shown & inside & sure[rows, columns] & (there_inverse > 0)
        there[good] = seen.points_at(found[good], there_inverse[good])
        return there

    def _gray(self, index: int) -> np.ndarray:
        if index not in self._grays:
            self._grays[index] = gray_at(self._data[index], self._flows.size(index))
        return self._grays[index]


def _sampled(values: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the values [h, w] at the nearest pixels to [P, 2]; 0 outside."""
    height, width = values.shape
    whole = np.nan_to_num(pixels, nan=-1.0, posinf=-1.0, neginf=-1.0).round().clip(-1, max(width, height)).astype(int)
    x, y = whole.T
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return np.where(inside, values[y.clip(0, height - 1), x.clip(0, width - 1)], 0.0)


def _interpolated(
    pixels: np.ndarray, displacements: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate displacements [P, 2] of pixels [P, 2] over an image: [h, w, 2], and [h, w] bool where one is near."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    distances, nearest = search_tree(pixels).query(np.stack([columns, rows], 2).reshape(-1, 2), k=AROUND)
    weights = 1.0 / np.square(distances + 0.5)
    weights /= weights.sum(1, keepdims=True)
    warp = (displacements[nearest] * weights[..., None]).sum(1).reshape(*shape, 2)
    return warp.astype(np.float32), (distances[:, 0] < REACH).reshape(shape)
