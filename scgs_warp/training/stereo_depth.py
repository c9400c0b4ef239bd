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
from ..geometry.normalisation import Normalisation
from ..runtime.progress import progress
from ..types import Frame
from .depth import KEPT_MIB, SeenDepth, seen_depth
from .flow import flow_size
from .standing_cameras import StandingCamera, levels, standing_cameras
from .stereo import StereoPair
from .view_rays import pixels_of

NEIGHBORS = 2
"""Number of cameras with which each camera is paired."""
NARROWEST, WIDEST = 1.0, 40.0
"""Range of the angle between two paired cameras, as seen from the content, degrees."""
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
        self.pairs = _pairs(known, standing)
        """By the cameras' numbers."""
        self._camera_of = {index: number for number, one in enumerate(standing) for index in one.frames}
        self._kept: dict[int, SeenDepth] = {}
        """Those of the matched moments, and of other frames as far as they fit."""
        self._bytes = 0
        """Of those other frames."""
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
        if index in self._kept or not self.pairs:
            return self._kept.get(index)
        try:
            frame = self.data[index]
        except UserError as error:
            raise FrameError(str(error)) from error
        number = self._camera_of[index]
        seen = self._seen(number, frame, np.where(self._changed(number, frame), np.float32(0.0), self._still[number]))
        if self._bytes + seen.inverse.nbytes <= KEPT_MIB * 2**20:
            self._kept[index] = seen
            self._bytes += seen.inverse.nbytes
        return seen

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
        points = self._points(list(self.pairs), pictures, everywhere)
        return [self._fused(number, each) for number, each in enumerate(points)]

    def _match(self, time: float, pairs: list[tuple[int, int]]) -> None:
        """Match the images of a moment where they differ from the medians."""
        frames = {number: self.data[index] for number, index in self.frames_at(time).items()}
        pictures = {number: levels(frame.image) for number, frame in frames.items()}
        changed = {
            number: self.standing[number].whole(self.standing[number].changed(frame))
            for number, frame in frames.items()
        }
        points = self._points([pair for pair in pairs if {*pair} <= {*frames}], pictures, changed)
        for number, index in self.frames_at(time).items():
            if points[number]:
                depth = self._fused(number, points[number])
                depth = np.where(self._changed(number, frames[number]), depth, self._still[number])
                self._kept[index] = self._seen(number, frames[number], depth)

    def _points(
        self, pairs: list[tuple[int, int]], pictures: dict[int, np.ndarray], regions: dict[int, np.ndarray]
    ) -> list[list[np.ndarray]]:
        """Match pairs in regions of their first cameras: for each camera, the points [P, 3] of each of its pairs."""
        points: list[list[np.ndarray]] = [[] for _ in self.standing]
        for one, two in pairs:
            found = self.pairs[one, two].match((pictures[one], pictures[two]), regions[one])[0]
            other = self.standing[two].camera
            pixels, depths = pixels_of(other, found)
            far_end = np.array([other.width, other.height]) - 1.0 - BORDER
            found = found[(depths > 0) & (pixels >= BORDER).all(1) & (pixels <= far_end).all(1)]
            points[one].append(found)
            points[two].append(found)
        return points

    def _fused(self, number: int, points: list[np.ndarray]) -> np.ndarray:
        """Return the depth [h, w] of a camera where the points of its pairs agree, 0 elsewhere."""
        camera, (width, height) = self.standing[number].camera, self.size(number)
        pixels, depths = pixels_of(camera, np.concatenate([np.zeros((0, 3)), *points]))
        places = (pixels + 0.5) / [camera.width, camera.height] * [width, height]
        inside = (depths > 0) & (places >= 0).all(1) & (places < [width, height]).all(1)
        columns, rows = np.floor(places[inside]).astype(int).T
        logs, cells = np.log(depths[inside]), rows * width + columns
        count = np.bincount(cells, minlength=width * height)
        mean = np.bincount(cells, logs, width * height) / np.maximum(count, 1)
        square = np.bincount(cells, np.square(logs - mean[cells]), width * height) / np.maximum(count, 1)
        agreed = (count > 0) & (square < SPREAD**2)
        return np.where(agreed, np.exp(mean), 0.0).reshape(height, width).astype(np.float32)

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


def stereo_depths(data: Dataset, normalisation: Normalisation) -> StereoDepths | None:
    """Find the depth of a rig's frames by stereo; None if the cameras do not stand still, or the data has no points."""
    if data.points is None:
        return None
    standing = standing_cameras(data, [normalisation.apply_camera(camera) for camera in data.cameras])
    return StereoDepths(normalisation.apply(data.points).float(), data, standing) if standing else None


def _pairs(known: Tensor, standing: list[StandingCamera]) -> dict[tuple[int, int], StereoPair]:
    """Pair each camera with the nearest by angle, as seen from the content."""
    places, pairs = known.double().numpy(), {}
    middle = known.double().median(0).values
    rays = torch.stack([one.camera.position.double() - middle for one in standing])
    rays = torch.nn.functional.normalize(rays, dim=1)
    angles = torch.rad2deg((rays @ rays.T).clamp(-1.0, 1.0).acos())
    for one, own in enumerate(angles):
        found = 0
        for two in own.argsort(stable=True).tolist():
            if found == NEIGHBORS or not NARROWEST <= own[two] <= WIDEST:
                continue
            key = min(one, two), max(one, two)
            pair = pairs.get(key) or StereoPair.of(standing[key[0]].camera, standing[key[1]].camera, places)
            if pair is not None:
                pairs[key], found = pair, found + 1
    return pairs
