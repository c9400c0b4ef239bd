"""Cameras that stand still, as those of a rig, and the part of their images in which something moves."""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..data.dataset import Dataset, spread
from ..runtime.progress import progress
from ..types import Camera
from .view_rays import pixels_of

LEAST_MOMENTS = 4
"""Least number of frames of a standing camera."""
MOST_MOMENTS = 24
"""Number of frames of a camera that are compared."""
DIFFERENT = 14.0
"""Difference from the median over time, in levels of 255, at which a pixel shows something else."""
OFTEN = 0.1
"""Share of the moments at which a pixel must be different to count as moving."""
AROUND = 5
"""Side of the square, in pixels, in which the majority decides."""
REACH = 0.006
"""Width by which moving regions are dilated, as a share of the longer side."""


class StandingCamera(NamedTuple):
    """A camera that stands still."""

    camera: Camera
    """On the host."""
    frames: list[int]
    """Indices of its frames, in order of time."""
    still: np.ndarray
    """[H, W, 3] the median over time, in levels."""
    moves: np.ndarray
    """[H, W] bool: pixels that change in the course of time."""

    def frame_at(self, time: float, data: Dataset) -> int:
        """Return the index of the frame nearest to a time."""
        return min(self.frames, key=lambda index: abs(data.entries[index].time - time))

    def changed(self, image: np.ndarray) -> np.ndarray:
        """Tell where an image [H, W, 3] uint8 of the camera shows something else than the median, [H, W] bool."""
        return _widened(_differs(image.astype(np.float32), self.still))

    def sees(self, points: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Tell which points [P, 3], in the frame of the camera's pose, are inside the image, and which of these lie in
        a region [H, W] bool of it, each [P] bool."""
        pixels, depths = pixels_of(self.camera, points)
        with np.errstate(invalid="ignore"):
            columns, rows = np.rint(np.nan_to_num(pixels, nan=-1.0, posinf=-1.0, neginf=-1.0)).T
        inside = (depths > 0) & (columns >= 0) & (rows >= 0)
        inside &= (columns < self.camera.width) & (rows < self.camera.height)
        within = np.zeros(len(points), bool)
        within[inside] = region[rows[inside].astype(int), columns[inside].astype(int)]
        return inside, within


def levels(image: Tensor) -> np.ndarray:
    """Return an image [H, W, 3] in [0, 1] as uint8; pixels that are not numbers, outside a mask, are black."""
    return (np.nan_to_num(image.numpy(), nan=0.0) * 255.0).round().clip(0, 255).astype(np.uint8)


def standing_cameras(data: Dataset, views: list[Camera]) -> list[StandingCamera]:
    """Find the cameras that stand still.

    Args:
        views: the cameras of the frames, in any frame of reference, on the host.

    Returns:
        The cameras in the order of their first frames; none of them unless all frames are of cameras that stand, at
        least two of them.
    """
    groups: dict[tuple, list[int]] = defaultdict(list)
    for index, view in enumerate(views):
        numbers = torch.cat([view.viewmat.flatten(), view.K.flatten()]).tolist()
        groups[(*(round(value, 5) for value in numbers), view.width, view.height)].append(index)
    if len(groups) < 2 or min(map(len, groups.values())) < LEAST_MOMENTS:
        return []
    standing = []
    with progress(len(groups), "looking for what moves") as bar:
        for indices in groups.values():
            indices.sort(key=lambda index: data.entries[index].time)
            still, moves = _still_and_moving(data, [indices[each] for each in spread(len(indices), MOST_MOMENTS)])
            standing.append(StandingCamera(views[indices[0]], indices, still, moves))
            bar.advance()
    return standing


def _still_and_moving(data: Dataset, frames: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the median [H, W, 3] of a camera's frames, and where they change, [H, W] bool."""
    stack = np.stack([levels(data[index].image) for index in frames])
    still = np.median(stack, axis=0).astype(np.float32)
    often = np.zeros(still.shape[:2], np.int32)
    for image in stack:
        often += _differs(image.astype(np.float32), still)
    return still, _widened(often >= max(2, OFTEN * len(stack)))


def _differs(image: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Tell which pixels of an image [H, W, 3] differ from the median, [H, W] bool, whatever the exposure of both."""
    exposure = np.median(still + 1.0) / np.median(image + 1.0)
    return cv2.blur(np.abs(image * exposure - still).max(2), (3, 3)) > DIFFERENT


def _widened(region: np.ndarray) -> np.ndarray:
    """Drop single pixels of a region [H, W] bool, close its holes, and dilate it."""
    kept = cv2.medianBlur(region.astype(np.uint8), AROUND)
    reach = max(1, round(REACH * max(region.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.morphologyEx(cv2.dilate(kept, disc), cv2.MORPH_CLOSE, disc).astype(bool)
