"""Clouds: points of what moves, each cloud of one instant, and what the ways to find them share.

``movers_by_stereo`` finds them before the standing cameras of a rig, ``movers_by_depth`` in a film with depth maps, and
``movers_by_flow`` a single one in a film without; ``points_on_movers`` chooses between them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..geometry.optical_flow import targets_of
from ..runtime.search_tree import search_tree
from .depth import FrameDepths
from .flow import Flows

LEAST_REGION = 0.002
"""Least share of the image that moves together."""
CLOSE, STRAY = 8, 3.0
"""Number of moving points around another, and the factor on the usual distance to them beyond which it is dropped."""


class Cloud(NamedTuple):
    """Points of one instant, from a frame of a film or from the frames of several cameras."""

    points: Tensor
    """[P, 3] normalised."""
    colors: Tensor
    """[P, 3]"""
    moves: Tensor
    """[P] bool: known to move."""
    time: float
    """Time of the instant, in [0, 1]."""
    later: Tensor | None = None
    """[P, 3] where the points are at the time of the following cloud; NaN where that is not known."""
    frames: Tensor | None = None
    """[P] int64, the frame in which each point is seen."""
    pixels: Tensor | None = None
    """[P, 2] (x, y) where it is seen, at the size of the flow; the centre of the first pixel is (0, 0)."""


class FrameCloud(NamedTuple):
    """The moving points that one frame sees."""

    index: int
    """The frame."""
    cloud: Cloud
    """With ``frames`` and ``pixels``."""


def frame_cloud(index: int, points: np.ndarray, colors: Tensor, time: float, pixels: np.ndarray) -> FrameCloud:
    """Return the cloud of moving points [P, 3], of colours [P, 3], that a frame sees at pixels [P, 2]."""
    frames, moves = torch.full((len(points),), index), torch.ones(len(points), dtype=torch.bool)
    found = torch.from_numpy(points).float(), colors, moves, time
    return FrameCloud(index, Cloud(*found, frames=frames, pixels=torch.from_numpy(pixels)))


def colors_at(image: Tensor, pixels: np.ndarray, size: tuple[int, int]) -> Tensor:
    """Return the colours [P, 3] of an image [H, W, 3] at pixels [P, 2] of a reduced version of (width, height)."""
    height, width = image.shape[:2]
    columns, rows = ((pixels + 0.5) * (np.array([width, height]) / size)).astype(int).T
    return image[rows.clip(0, height - 1), columns.clip(0, width - 1)]


def strays(points: np.ndarray) -> np.ndarray:
    """Tell which of the points [P, 3] are far from others, [P] bool."""
    if len(points) <= CLOSE:
        return np.zeros(len(points), bool)
    distances = search_tree(points).query(points, k=CLOSE + 1)[0][:, -1]
    return distances > STRAY * np.median(distances)


def later_places(one: FrameCloud, following: int, flows: Flows, depths: FrameDepths) -> Tensor:
    """Return where the points of a frame are in a later one, [P, 3]: at the depth of the pixel to which flow leads; NaN
    where flow or depth is not known."""
    assert one.cloud.pixels is not None, "seen by a frame"
    pixels = one.cloud.pixels.numpy()
    there = np.full((len(pixels), 3), np.nan)
    path, seen = flows.between_frames(one.index, following), depths.of(following)
    if path is None or seen is None:
        return torch.from_numpy(there).float()
    vectors, certain = flows.along(path)
    columns, rows = pixels.astype(int).T
    targets = targets_of(vectors)[rows, columns].astype(np.float64)
    x, y = targets.round().astype(int).T
    height, width = seen.inverse.shape
    inverse = seen.inverse.numpy()[y.clip(0, height - 1), x.clip(0, width - 1)]
    known = certain[rows, columns] & (inverse > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    there[known] = seen.points_at(targets[known], inverse[known])
    return torch.from_numpy(there).float()
