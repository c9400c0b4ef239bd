"""Initial points of data whose frames have depth maps."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..geometry.pinhole import projected
from ..types import Camera
from .dataset import Dataset, spread
from .depth_cloud import depth_cloud

POINT_FRAMES = 24
"""Number of frames whose depth gives points."""
POINT_COUNT = 100_000
"""Number of points, from all these frames together."""
DISAGREE = 0.15
"""Median relative difference of depth, between maps of two frames, above which maps are not in the units of the
poses. What moves, and what one frame hides, are in the smaller half."""


class _Cloud(NamedTuple):
    """Points of one frame's depth map."""

    camera: Camera
    depth: Tensor
    points: np.ndarray
    """[P, 3] world units."""
    colors: np.ndarray
    """[P, 3] in [0, 1]."""


def points_of_depth(
    data: Dataset, check: Callable[[str, Tensor], None] = lambda name, known: None, agreeing: bool = False
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return points [P, 3] of the surfaces that depth maps show, world units, and their colours [P, 3] in [0, 1].

    Pixels that a frame's mask excludes give none.

    Args:
        check: called with a frame's name and the known values of its map, if any; may raise.
        agreeing: return nothing if maps disagree with each other: their unit may be wrong, or differ between frames.

    Returns:
        None without depth.

    Raises:
        UserError: a map is damaged or does not fit its image.
    """
    chosen = [data.with_depth[place] for place in spread(len(data.with_depth), POINT_FRAMES)]
    clouds = []
    for index in chosen:
        depth, frame = data.depth(index), data[index]
        assert depth is not None, "asked for frames with a depth map only"
        if frame.mask is not None:
            shown = F.interpolate(frame.mask[None, None].float(), size=depth.shape)[0, 0]
            depth = depth * shown
        known = depth[depth > 0]
        if len(known):
            check(frame.name, known)
        K, viewmat = frame.camera.K.double().numpy(), frame.camera.viewmat.double().numpy()
        cloud = depth_cloud(depth.numpy(), frame.image.numpy(), K, viewmat, POINT_COUNT // len(chosen))
        clouds.append(_Cloud(frame.camera, depth, *cloud))
    if not any(len(cloud.points) for cloud in clouds) or (agreeing and not _agree(clouds)):
        return None
    return np.concatenate([cloud.points for cloud in clouds]), np.concatenate([cloud.colors for cloud in clouds])


def _agree(clouds: list[_Cloud]) -> bool:
    """Decide whether each frame sees the points of the frame before it about where its own map puts them."""
    found = [_differences(before, after) for before, after in pairwise(clouds)]
    apart = np.concatenate([np.zeros(0), *found])
    return len(apart) > 0 and float(np.median(apart)) <= DISAGREE


def _differences(before: _Cloud, after: _Cloud) -> np.ndarray:
    """Return the relative differences [Q] of depth at the points of ``before`` that ``after`` sees."""
    camera, (height, width) = after.camera, after.depth.shape
    pixels, local = projected(torch.from_numpy(before.points).float(), camera)
    columns, rows = (pixels[:, 0] * width / camera.width).floor(), (pixels[:, 1] * height / camera.height).floor()
    inside = (local[:, 2] > 0) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    depth = after.depth[rows[inside].long(), columns[inside].long()]
    known = depth > 0
    return (local[inside, 2][known] / depth[known] - 1.0).abs().numpy()
