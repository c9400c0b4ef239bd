"""Cameras that stand still, as those of a rig, and the part of their images in which something moves."""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..data.dataset import Dataset, spread
from ..geometry.pinhole import pixels_of
from ..runtime.progress import progress
from ..types import Camera, Frame

LEAST_MOMENTS = 4
"""Least number of frames of a standing camera."""
MOST_MOMENTS, SIDE = 24, 640
"""Number of frames of a camera that are compared, and the longer side to which they are reduced, pixels."""
DIFFERENT, STRONGLY = 14.0, 42.0
"""Differences from the median over time, in levels of 255, at which a pixel shows something else. It moves if that
happens twice, or once strongly."""
BRIGHT = 20.0
"""Level from which pixels tell the exposure."""
AROUND = 5
"""Side of the square, in pixels, in which the majority decides."""
REACH = 0.006
"""Width by which moving regions are dilated, as a share of the longer side."""
LATE = 0.6
"""Distance in time to the nearest frame, as a share of the time between frames, from which a camera has none."""


class StandingCamera(NamedTuple):
    """A camera that stands still."""

    camera: Camera
    """On the host."""
    frames: list[int]
    """Indices of its frames, in order of time."""
    still: np.ndarray
    """[h, w, 3] the median over time, in levels; the images are reduced."""
    moves: np.ndarray
    """[h, w] bool: pixels that change in the course of time."""
    spacing: float
    """Median time between frames."""

    def frame_at(self, time: float, data: Dataset) -> int | None:
        """Return the index of the frame nearest to a time, or None if the camera has no frame then."""
        nearest = min(self.frames, key=lambda index: abs(data.entries[index].time - time))
        return nearest if abs(data.entries[nearest].time - time) <= LATE * self.spacing else None

    def changed(self, frame: Frame) -> np.ndarray:
        """Tell where a frame of the camera shows something else than the median, [h, w] bool."""
        return _widened(_difference(*reduced(frame), self.still) > DIFFERENT)

    def whole(self, region: np.ndarray) -> np.ndarray:
        """Enlarge a region [h, w] bool to the size of the images, [H, W]."""
        size = self.camera.width, self.camera.height
        return cv2.resize(region.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)

    def sees(self, points: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Tell which points [P, 3], in the frame of the camera's pose, are inside the image, and which of these lie in
        a region [h, w] bool of it, each [P] bool."""
        pixels, depths = pixels_of(self.camera, points)
        size = np.array([self.camera.width, self.camera.height])
        with np.errstate(invalid="ignore"):
            shares = np.nan_to_num((pixels + 0.5) / size, nan=-1.0, posinf=-1.0, neginf=-1.0)
        inside = (depths > 0) & (shares >= 0).all(1) & (shares < 1).all(1)
        columns, rows = np.floor(shares[inside] * np.array(region.shape[::-1])).astype(int).T
        within = np.zeros(len(points), bool)
        within[inside] = region[rows, columns]
        return inside, within


def levels(image: Tensor) -> np.ndarray:
    """Return an image [H, W, 3] in [0, 1] as uint8."""
    return (np.nan_to_num(image.numpy(), nan=0.0) * 255.0).round().clip(0, 255).astype(np.uint8)


def reduced(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Return a frame's image [h, w, 3] float32 in levels, reduced, and its valid pixels [h, w] bool."""
    image = levels(frame.image)
    valid = np.ones(image.shape[:2], bool) if frame.mask is None else frame.mask.numpy()
    scale = min(1.0, SIDE / max(image.shape[:2]))
    size = tuple(max(1, round(scale * side)) for side in image.shape[1::-1])
    shown = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return shown, cv2.resize(valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)


def standing_groups(data: Dataset, views: list[Camera]) -> list[list[int]]:
    """Return the indices of each standing camera's frames in order of time, the cameras in the order of their first
    frames; none unless all frames are of cameras that stand, at least two of them.

    Args:
        views: the cameras of the frames, normalised, on the host.
    """
    groups: dict[tuple, list[int]] = defaultdict(list)
    for index, view in enumerate(views):
        numbers = torch.cat([view.viewmat.flatten(), view.K.flatten()]).tolist()
        groups[(*(round(value, 5) for value in numbers), view.width, view.height)].append(index)
    if len(groups) < 2 or min(map(len, groups.values())) < LEAST_MOMENTS:
        return []
    return [sorted(indices, key=lambda index: data.entries[index].time) for indices in groups.values()]


def standing_cameras(data: Dataset, views: list[Camera]) -> list[StandingCamera]:
    """Find the cameras that stand still, and what moves before them (:func:`standing_groups`)."""
    groups = standing_groups(data, views)
    if not groups:
        return []
    standing = []
    with progress(len(groups), "looking for what moves") as bar:
        for indices in groups:
            still, moves = _still_and_moving(data, [indices[each] for each in spread(len(indices), MOST_MOMENTS)])
            times = np.array([data.entries[index].time for index in indices])
            standing.append(StandingCamera(views[indices[0]], indices, still, moves, float(np.median(np.diff(times)))))
            bar.advance()
    return standing


def _still_and_moving(data: Dataset, frames: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the median [h, w, 3] of the valid pixels of a camera's frames, and where they change, [h, w] bool."""
    images, valid = (np.stack(each) for each in zip(*(reduced(data[index]) for index in frames)))
    if valid.all():
        still = np.median(images, axis=0)
    else:
        hidden = np.where(valid[..., None], images, np.nan)
        hidden[0][~valid.any(0)] = 0.0  # no frame shows these
        still = np.nanmedian(hidden, axis=0).astype(np.float32)
    often = np.zeros(still.shape[:2], np.int32)
    for image, shown in zip(images, valid):
        difference = _difference(image, shown, still)
        often += (difference > DIFFERENT).astype(np.int32) + (difference > STRONGLY)
    return still, _widened(often >= 2)


def _difference(image: np.ndarray, valid: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Return by how many levels an image [h, w, 3] differs from the median, [h, w], whatever the exposure of both; 0
    where it is not valid."""
    bright = valid & (still.min(2) > BRIGHT)
    exposure = np.median((image.sum(2) + 1.0)[bright] / (still.sum(2) + 1.0)[bright]) if bright.any() else 1.0
    difference = np.abs(image / max(float(exposure), 1e-3) - still).max(2) * valid
    return cv2.blur(difference, (3, 3))


def _widened(region: np.ndarray) -> np.ndarray:
    """Drop single pixels of a region [H, W] bool, close its holes, and dilate it."""
    kept = cv2.medianBlur(region.astype(np.uint8), AROUND)
    reach = max(1, round(REACH * max(region.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.morphologyEx(cv2.dilate(kept, disc), cv2.MORPH_CLOSE, disc).astype(bool)
