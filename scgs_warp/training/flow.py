"""Optical flow of a film as a term of the loss: Gaussians move in the image as the film does.

The photometric loss finds a motion only if both images overlap. Flow between frames that follow each other says where
each pixel goes, at any range, and composes to longer spans. The term compares it with the displacement of the
Gaussians' projected centres, blended as colours are (rendered flow).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..config.presets import TrainConfig
from ..data.dataset import Dataset, neighbors_in_time
from ..geometry.cameras import scaled_camera
from ..geometry.optical_flow import at_targets, dense_flow, returns, targets_of, textured
from ..ops.binning import bin_splats
from ..ops.compositing import composite
from ..ops.projection import project
from ..runtime.environment import one_piece
from ..types import Camera, Frame, Gaussians

FLOW_SIDE = 512
"""Longer side of the images between which flow is measured, at most, pixels."""
TERM_SIDE = 256
"""Longer side of the images in which flow is compared, at most, pixels."""
ROUND_TRIP = 0.004
"""Largest distance between a pixel and its position after flow forth and back, as a share of the longer side."""
SPANS = (1, 2, 4, 8)
"""Numbers of frames over which flow is compared; one is drawn for each step."""
KEPT_MIB = 128
"""Memory for the flow of a run. On a CPU it holds 400 frames of 16 : 9; that of others is found again at each use."""
OPAQUE = 0.5
"""Rendered alpha below which a pixel is not compared."""
NEAREST_DEPTH = 1e-2
"""Depth, normalised, below which a Gaussian has no flow."""
MOST_TURN = 12.0
"""Largest median angle, in degrees, between the directions in which neighbouring frames of a film look."""
LEAST_CERTAIN = 0.25
"""Least share of an image at which flow is certain, in the median of some pairs, for frames that follow each other."""
JUDGED_PAIRS = 5
"""Number of pairs of frames from which it is told whether they follow each other."""


class Flow(NamedTuple):
    """Flow from a frame to one before or after it, compared at a reduced size."""

    camera: Camera
    """Of the frame, normalised, on the host, with the size of the flow."""
    other: int
    """Index of the other frame."""
    other_camera: Camera
    time: float
    """Time of the other frame."""
    vectors: Tensor
    """[2, h, w] pixels of this size, on the host."""
    certain: Tensor
    """[h, w] bool"""


class FlowNumbers(NamedTuple):
    """What a step compares, on the device."""

    camera: Camera
    other: Camera
    vectors: Tensor
    certain: Tensor
    weight: float


class Flows:
    """Flow between the training frames of a film, measured when it is first asked for."""

    def __init__(self, data: Dataset, views: Sequence[Camera]) -> None:
        """
        Args:
            views: normalised cameras of the frames, on the host.
        """
        self._data, self._views = data, views
        self._neighbors = neighbors_in_time(data)
        self._kept: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        self._bytes = 0

    def between(self, index: int, random: torch.Generator) -> Flow | None:
        """Return the flow from a frame to one that is up to eight frames before or after it, drawn at random; None at
        the end of the film."""
        draws = torch.rand(2, generator=random).tolist()
        span, side = SPANS[int(draws[0] * len(SPANS))], int(draws[1] * 2)
        path = self.path(index, span, side)
        path = self.path(index, span, 1 - side) if len(path) == 1 else path
        if len(path) == 1:
            return None
        vectors, certain = self.along(path)
        camera, other = (self.camera(i) for i in (index, path[-1]))
        planar = torch.from_numpy(np.ascontiguousarray(vectors.transpose(2, 0, 1)))
        return Flow(camera, path[-1], other, self._data.entries[path[-1]].time, planar, torch.from_numpy(certain))

    def camera(self, index: int) -> Camera:
        """Return the normalised camera of a frame, at the size of the flow, on the host."""
        return scaled_camera(self._views[index], *self.size(index))

    def size(self, index: int) -> tuple[int, int]:
        """Return width and height of the flow of a frame, pixels."""
        return flow_size(self._views[index].width, self._views[index].height)

    def path(self, index: int, span: int, side: int) -> list[int]:
        """Return a frame and up to ``span`` frames before (side 0) or after it (side 1), of one size."""
        path, views = [index], self._views
        while len(path) <= span:
            following = int(self._neighbors[path[-1], side])
            if following == path[-1] or _size(views[following]) != _size(views[index]):
                break
            path.append(following)
        return path

    def between_frames(self, one: int, two: int) -> list[int] | None:
        """Return the path from a frame to a later one; None if there is none of one size."""
        path = [one]
        while path[-1] != two:
            following = self.path(path[-1], 1, 1)
            if len(following) == 1 or self._data.entries[following[1]].time > self._data.entries[two].time:
                return None
            path.append(following[1])
        return path

    def along(self, path: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Compose the flow of neighbours: vectors [h, w, 2], and [h, w] bool where all of it is certain."""
        vectors, certain = self._pair(path[0], path[1])
        vectors = vectors.astype(np.float32)
        for one, two in itertools.pairwise(path[1:]):
            more, sure = self._pair(one, two)
            targets = targets_of(vectors)
            vectors = vectors + at_targets(more.astype(np.float32), targets)
            certain = certain & (at_targets(sure.astype(np.float32), targets) > 0.99)
        return vectors, certain

    def followed(
        self, index: int, pixels: np.ndarray, spans: Sequence[int]
    ) -> Iterator[tuple[Camera, np.ndarray, np.ndarray]]:
        """Follow pixels [P, 2] of a frame to the frames that are ``spans`` before and after it, as far as the film
        goes: yield each one's camera, the places [P, 2] in it, and [P] bool where they are certain."""
        columns, rows = pixels.astype(int).T
        for side in (0, 1):
            for span in spans:
                path = self.path(index, span, side)
                if len(path) <= span:
                    break
                vectors, certain = self.along(path)
                targets = targets_of(vectors)[rows, columns].astype(np.float64)
                yield self.camera(path[-1]), targets, certain[rows, columns]

    def _pair(self, one: int, two: int) -> tuple[np.ndarray, np.ndarray]:
        kept = self._kept.get((one, two))
        if kept is not None:
            return kept
        forth, back = measured(self._data[one], self._data[two])
        size = sum(array.nbytes for array in (*forth, *back))
        if self._bytes + size <= KEPT_MIB * 2**20:
            self._kept[one, two], self._kept[two, one] = forth, back
            self._bytes += size
        return forth


def measured(one: Frame, two: Frame) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Measure the flow from one frame to another and back: vectors [h, w, 2] float16 at the reduced size, and [h, w]
    bool where they are certain, for each direction."""
    grays = [_gray(frame) for frame in (one, two)]
    forth, back = dense_flow(*grays), dense_flow(*reversed(grays))
    height, width = grays[0].shape
    most = ROUND_TRIP * max(height, width)
    size = flow_size(one.camera.width, one.camera.height)
    results = []
    for frame, gray, there, home in ((one, grays[0], forth, back), (two, grays[1], back, forth)):
        sure = returns(there, home, most) & textured(gray)
        if frame.mask is not None:
            sure &= cv2.resize(frame.mask.numpy().astype(np.uint8), (width, height), interpolation=cv2.INTER_AREA) == 1
        if frame.alpha is not None:
            sure &= cv2.resize(frame.alpha.numpy(), (width, height), interpolation=cv2.INTER_AREA) > OPAQUE
        scale = np.array([size[0] / width, size[1] / height], np.float32)
        vectors = cv2.resize(there, size, interpolation=cv2.INTER_AREA) * scale
        certain = cv2.resize(sure.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
        results.append((vectors.astype(np.float16), certain))
    return results[0], results[1]


def flow_size(width: int, height: int) -> tuple[int, int]:
    """Return the width and height at which the flow between images of a size is kept."""
    factor = min(1.0, TERM_SIDE / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def gray_at(frame: Frame, size: tuple[int, int]) -> np.ndarray:
    """Return a frame in grey, [h, w] uint8, reduced to (width, height)."""
    return cv2.resize(_gray(frame), size, interpolation=cv2.INTER_AREA)


def _gray(frame: Frame) -> np.ndarray:
    """Return a frame in grey, [h, w] uint8, at most ``FLOW_SIDE`` pixels wide and high."""
    levels = (frame.image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).contiguous().numpy()
    gray = cv2.cvtColor(levels, cv2.COLOR_RGB2GRAY)
    factor = FLOW_SIDE / max(gray.shape)
    return gray if factor >= 1.0 else cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def flow_term(here: Gaussians, there: Tensor, seen: FlowNumbers) -> Tensor:
    """Return the mean distance between the rendered and the measured flow, as a share of the image's longer side.

    Args:
        here: N Gaussians at the time of the frame.
        there: [N, 3] their means at the time of the other frame.
        seen: measured flow and cameras, on the device of the Gaussians.

    Returns:
        Scalar. Gradients flow to ``here.means`` and ``there`` as the ends of displacements; what covers a pixel gets
        none, since flow would otherwise pay with transparency.
    """
    camera, other = seen.camera, seen.other
    shape = here.quats.detach(), here.scales.detach(), here.opacities.detach()
    with torch.no_grad():
        size = camera.width, camera.height
        splats = project(here.means.detach(), *shape, camera.viewmat, camera.K, *size, sharpness=here.sharpness)
    with one_piece():
        before, ahead = _projected(here.means, camera)
        after, still_ahead = _projected(there, other)
        displacements = torch.where((ahead & still_ahead)[:, None], after - before, 0.0)
    image, alpha = composite(splats, displacements, bin_splats(splats))
    with one_piece():
        compared = seen.certain & (alpha.detach() > OPAQUE)
        rendered = image / alpha.detach().clamp_min(OPAQUE)
        apart = (rendered - seen.vectors).square().sum(0)
        distances = (apart + 1e-4).sqrt() - 1e-2
        total = torch.where(compared, distances, 0.0).sum()
        return total / (compared.sum().clamp_min(1) * max(size))


def _size(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height


def _projected(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the pixels [N, 2] of points [N, 3], and [N] bool where they lie before the camera."""
    rows = camera.viewmat
    x, y, z = (points[:, 0] * row[0] + points[:, 1] * row[1] + points[:, 2] * row[2] + row[3] for row in rows[:3])
    ahead = z > NEAREST_DEPTH
    z = torch.where(ahead, z, 1.0)
    return torch.stack([camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]], 1), ahead


def flow_applies(step: int, config: TrainConfig) -> bool:
    """Return True during the main steps some of which compare flow."""
    return config.loss.flow > 0.0 and config.rest_steps <= step < config.loss.flow_until * config.main_steps


def flow_weight(step: int, config: TrainConfig) -> float:
    """Return the weight of the term at a main step; 0 in steps without it, and while the motion does not learn. It
    fades linearly until ``loss.flow_until``."""
    loss, until = config.loss, config.loss.flow_until * config.main_steps
    if not flow_applies(step, config) or step % loss.flow_every:
        return 0.0
    return loss.flow * loss.flow_every * (1.0 - step / until)


def follow_each_other(data: Dataset) -> bool:
    """Tell whether neighbouring frames show nearly the same, so that there is flow between them: the frames of a film
    or of cameras that stand still do, those of a camera that stands elsewhere at each instant do not."""
    if len(data) < 3 or len(data.times.unique()) < 3:
        return False
    neighbors = neighbors_in_time(data)[:, 1].tolist()
    pairs = [(one, two) for one, two in enumerate(neighbors) if one != two]
    looks = torch.stack([camera.viewmat[2, :3].double().cpu() for camera in data.cameras])
    cosines = torch.stack([(looks[one] * looks[two]).sum() for one, two in pairs]).clamp(-1.0, 1.0)
    if math.degrees(float(cosines.acos().median())) > MOST_TURN:
        return False
    chosen = np.unique(np.linspace(0, len(pairs) - 1, JUDGED_PAIRS).round().astype(int))
    shares = []
    for one, two in (pairs[i] for i in chosen):
        certain = measured(data[one], data[two])[0][1]
        alpha = data[one].alpha
        shares.append(
            float(certain.mean()) / (1.0 if alpha is None else max(float((alpha > OPAQUE).float().mean()), 1e-6))
        )
    return float(np.median(shares)) >= LEAST_CERTAIN
