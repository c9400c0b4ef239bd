"""Depth maps of the frames of a rig, by stereo between its cameras.

Its few cameras stand far apart, so that images alone leave many distances open. What stands still is matched once, in
the medians over time. Where a frame shows something else than the median, images of its own moment are matched.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from torch import Tensor

from ..data.dataset import Dataset, spread
from ..errors import FrameError, UserError
from ..geometry.cameras import scaled_camera
from ..geometry.normalisation import Normalisation
from ..geometry.pinhole import pixels_of
from ..geometry.stereo import stereo_pairs
from ..runtime.progress import progress
from ..types import Camera, Frame
from .depth import SeenDepth, seen_depth
from .flow import flow_size
from .standing_cameras import StandingCamera, levels, standing_cameras

MOST_MOMENTS, MOST_MATCHES = 24, 160
"""Largest number of moments that are matched, and about the largest number of matches in all. With more pairs of
cameras, moments take turns with them, except the middle one, where Gaussians begin."""
SPREAD = 0.02
"""Largest standard deviation of the logarithm of the depths within a pixel."""
APART = 0.9
"""Least time between two moments, as a share of the time between frames: at less, some cameras show the same frame."""
BORDER = 1.0
"""Width of the border of the second picture in which no match counts, pixels: nothing is beyond it."""


class StereoDepths:
    """Depth of the training frames of standing cameras."""

    def __init__(self, known: Tensor, data: Dataset, standing: list[StandingCamera]) -> None:
        """Match the medians and the images of up to ``MOST_MOMENTS`` moments.

        Args:
            known: [P, 3] sparse points of the data, in the frame of the cameras' poses.
        """
        self.data, self.standing = data, standing
        self.pairs = stereo_pairs(dict(enumerate(one.camera for one in standing)), known.double().numpy())
        """By the cameras' numbers."""
        self._camera_of = {index: number for number, one in enumerate(standing) for index in one.frames}
        self._matched: dict[int, SeenDepth] = {}
        """Depth of the frames at matched moments."""
        self._known: dict[int, np.ndarray] = {}
        """Which pixels of other frames have the depth of what stands still, as bits: a rig may have many frames."""
        every = self._instants()
        self.moments = [every[index] for index in spread(len(every), MOST_MOMENTS)] if self.pairs else []
        turns = math.ceil(len(self.pairs) * len(self.moments) / MOST_MATCHES)
        middle = min(self.moments, key=lambda time: abs(time - 0.5), default=0.0)
        with progress(1 + len(self.moments), "depth by stereo") as bar:
            self._still = self._of_medians()
            bar.advance()
            for number, time in enumerate(self.moments):
                self._match(time, list(self.pairs) if time == middle else list(self.pairs)[number % turns :: turns])
                bar.advance()

    @property
    def available(self) -> bool:
        """True if frames have depth."""
        return bool(self.pairs)

    def of(self, index: int) -> SeenDepth | None:
        """Return the depth of a frame, on the host; None without pairs of cameras.

        Raises:
            FrameError: the frame's file is no longer readable.
        """
        if index in self._matched or not self.pairs:
            return self._matched.get(index)
        number = self._camera_of[index]
        depth = self._still[number]
        if index not in self._known:
            try:
                frame = self.data[index]
            except UserError as error:
                raise FrameError(str(error)) from error
            seen = self._seen(number, frame, np.where(self._changed(number, frame), np.float32(0.0), depth))
            self._known[index] = np.packbits(seen.inverse.numpy() > 0)
        known = np.unpackbits(self._known[index], count=depth.size).reshape(depth.shape)
        with np.errstate(divide="ignore"):
            inverse = np.where(known, 1.0 / np.maximum(depth, 1e-30), 0.0).astype(np.float32)
        return SeenDepth(scaled_camera(self.standing[number].camera, *self.size(number)), torch.from_numpy(inverse))

    def matches(self, index: int) -> bool:
        """Return True for a frame whose images were matched at its own moment, so that movers have depth."""
        return index in self._matched

    def frame_then(self, index: int, time: float) -> int | None:
        """Return the frame of the same camera nearest to a time; None if its movers have no depth."""
        other = self.frames_at(time).get(self._camera_of[index])
        return other if other is not None and self.matches(other) else None

    def size(self, number: int) -> tuple[int, int]:
        """Return width and height of the depth of a camera's frames."""
        camera = self.standing[number].camera
        return flow_size(camera.width, camera.height)

    def frames_at(self, time: float) -> dict[int, int]:
        """Return the index of each camera's frame nearest to a time, by the number of the camera; those without a frame
        then are left out."""
        at = {number: one.frame_at(time, self.data) for number, one in enumerate(self.standing)}
        return {number: index for number, index in at.items() if index is not None}

    def _instants(self) -> list[float]:
        """Return times at which cameras have frames. Those of cameras that are not locked count as one instant if they
        are close."""
        least, instants = APART * float(np.median([one.spacing for one in self.standing])), []
        for time in sorted({self.data.entries[index].time for one in self.standing for index in one.frames}):
            if not instants or time - instants[-1] >= least:
                instants.append(time)
        return instants

    def _of_medians(self) -> list[np.ndarray]:
        """Match what stands still: the depth [h, w] of each camera, 0 where unknown."""
        pictures = {}
        for number, one in enumerate(self.standing):
            enlarged = cv2.resize(one.still, (one.camera.width, one.camera.height), interpolation=cv2.INTER_CUBIC)
            pictures[number] = enlarged.round().clip(0, 255).astype(np.uint8)
        everywhere = {number: np.ones(picture.shape[:2], bool) for number, picture in pictures.items()}
        return [each.depth() for each in self._mapped(list(self.pairs), pictures, everywhere)]

    def _match(self, time: float, pairs: list[tuple[int, int]]) -> None:
        """Match the images of a moment where they differ from the medians."""
        here = self.frames_at(time)
        frames = {number: self.data[index] for number, index in here.items()}
        pictures = {number: levels(frame.image) for number, frame in frames.items()}
        changed = {
            number: self.standing[number].whole(self.standing[number].changed(frame))
            for number, frame in frames.items()
        }
        pairs = [pair for pair in pairs if {*pair} <= {*frames}]
        maps = self._mapped(pairs, pictures, changed)
        for number in {number for pair in pairs for number in pair}:
            depth = np.where(self._changed(number, frames[number]), maps[number].depth(), self._still[number])
            self._matched[here[number]] = self._seen(number, frames[number], depth)

    def _mapped(
        self, pairs: list[tuple[int, int]], pictures: dict[int, np.ndarray], regions: dict[int, np.ndarray]
    ) -> list[_DepthMap]:
        """Match pairs in regions of their first cameras, and gather the points in the maps of both."""
        maps = [_DepthMap(one.camera, self.size(number)) for number, one in enumerate(self.standing)]
        for one, two in pairs:
            found = self.pairs[one, two].match((pictures[one], pictures[two]), regions[one])[0]
            other = self.standing[two].camera
            pixels, depths = pixels_of(other, found)
            far_end = np.array([other.width, other.height]) - 1.0 - BORDER
            found = found[(depths > 0) & (pixels >= BORDER).all(1) & (pixels <= far_end).all(1)]
            maps[one].add(found)
            maps[two].add(found)
        return maps

    def _changed(self, number: int, frame: Frame) -> np.ndarray:
        """Tell where a frame shows something else than the median, [h, w] bool, at the size of the depth."""
        changed = self.standing[number].changed(frame).astype(np.uint8)
        return cv2.resize(changed, self.size(number), interpolation=cv2.INTER_NEAREST) > 0

    def _seen(self, number: int, frame: Frame, depth: np.ndarray) -> SeenDepth:
        """Make the depth of a camera's frame of a map [h, w], without masked pixels."""
        if frame.mask is not None:
            shown = cv2.resize(frame.mask.numpy().astype(np.float32), depth.shape[::-1], interpolation=cv2.INTER_AREA)
            depth = depth * (shown > 1.0 - 1e-4)
        return seen_depth(depth, self.standing[number].camera)


class _DepthMap:
    """Depth of a camera, from the points of its pairs. Sums are kept, not points: those of a large rig are many."""

    def __init__(self, camera: Camera, size: tuple[int, int]) -> None:
        self._camera, self._size = camera, size
        self._sums = np.zeros((3, size[0] * size[1]))
        """Per pixel, the number of points and the sums of the logarithm of their depths and of its square."""

    def add(self, points: np.ndarray) -> None:
        """Add the points [P, 3] in view."""
        camera, (width, height) = self._camera, self._size
        pixels, depths = pixels_of(camera, points)
        places = (pixels + 0.5) / [camera.width, camera.height] * [width, height]
        inside = (depths > 0) & (places >= 0).all(1) & (places < [width, height]).all(1)
        columns, rows = np.floor(places[inside]).astype(int).T
        logs, cells = np.log(depths[inside]), rows * width + columns
        for total, values in zip(self._sums, (None, logs, np.square(logs))):
            total += np.bincount(cells, values, len(total))

    def depth(self) -> np.ndarray:
        """Return the depth [h, w] where the points agree, 0 elsewhere."""
        count, total, squares = self._sums
        mean = total / np.maximum(count, 1)
        agreed = (count > 0) & (squares / np.maximum(count, 1) - np.square(mean) < SPREAD**2)
        return np.where(agreed, np.exp(mean), 0.0).reshape(self._size[::-1]).astype(np.float32)


def stereo_depths(data: Dataset, normalisation: Normalisation) -> StereoDepths | None:
    """Find the depth of a rig's frames by stereo; None if the cameras do not stand still, or the data has no points."""
    if data.points is None:
        return None
    standing = standing_cameras(data, [normalisation.apply_camera(camera) for camera in data.cameras])
    return StereoDepths(normalisation.apply(data.points).float(), data, standing) if standing else None
