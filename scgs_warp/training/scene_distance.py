"""Distance of a scene from cameras that look the same way: a parallel rig, a camera on a tripod, a sideways drive.

Optical axes that hardly converge meet at a place that errors of the poses decide. The distance is that of the data's
points, depth bounds or depth maps, or that at which most of the parallax between images fits the poses.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..data.dataset import Dataset, spread
from ..geometry.cameras import (
    Overview,
    nearest_to_axes,
    overview,
    places_and_directions,
    rounding,
    scaled_camera,
)
from ..geometry.normalisation import FEWEST_POINTS, Normalisation
from ..geometry.optical_flow import targets_of
from .flow import flow_size, measured

SAME_WAY = 0.7
"""Least length of the mean of the optical axes of cameras that look the same way: they are within 45 degrees of it."""
CONVERGES = 1.0
"""Least root mean square distance by which axes converge, in units of that by which they miss the point nearest to
them. Below it, they miss each other by more than they converge."""
IN_FRONT = 0.75
"""Least share of the cameras before which their axes meet."""
MOST_FRAMES = 8
"""Number of frames, spread over the data, from which parallax is measured to others."""
AT_ONCE = 1e-6
"""Largest difference between the times of one instant."""
LIKE = 0.98
"""Least cosine between the axes of two cameras between which parallax is measured."""
NEARBY = 0.25
"""Largest difference between the times of two frames of one camera between which parallax is measured."""
LEAST_CERTAIN = 0.02
"""Least share of an image at which flow is certain."""
PIXEL = 0.2
"""Standard error of the parallax of a pair of images, pixels."""
CERTAIN = 3.0
"""Least inverse distance that is known, in units of its standard error. Below, the scene is as near as it may be."""
NEAREST, NO_PARALLAX, FARTHEST = 2.0, 100.0, 1e4
"""Least distance, least distance if images show no parallax, and largest distance, in units of the cameras' spread."""


class Placement(NamedTuple):
    """Where a scene is before its cameras."""

    normalisation: Normalisation
    overview: Overview
    guessed: bool
    """True if neither the cameras nor points, bounds or parallax tell the distance of the scene."""


def place(data: Dataset) -> Placement:
    """Locate the scene of a data set."""
    distance, guessed = _distance(data)
    cameras = data.cameras
    return Placement(Normalisation.fit(cameras, data.points, distance), overview(cameras, distance), guessed)


def _distance(data: Dataset) -> tuple[float | None, bool]:
    """Return the distance of the scene before the mean camera, None where the axes meet or nothing sets a scale; and
    whether it is a guess."""
    positions, axes = places_and_directions(data.cameras)
    if np.linalg.norm(axes.mean(axis=0)) < SAME_WAY:
        return None, False
    with_points = data.points is not None and len(data.points) >= FEWEST_POINTS
    if _meet(positions, axes, 0.0 if with_points else CONVERGES):
        return None, False
    if data.points is not None and with_points:
        depth = depth_ahead(positions, axes, np.median(data.points.double().numpy(), axis=0))
        return (depth if depth > 0.0 else None), False
    if data.bounds is not None:
        return 2.0 / (1.0 / data.bounds[0] + 1.0 / data.bounds[1]), False
    depth = _mapped_depth(data)
    if depth is not None:
        return depth, False
    size = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())
    if size <= rounding(positions):
        return None, True
    inverse, error = _inverse_distance(data, positions, axes)
    if inverse > CERTAIN * error:
        return float(np.clip(1.0 / inverse, NEAREST * size, FARTHEST * size)), False
    if not np.isfinite(error):
        return None, True
    return float(np.clip(1.0 / (max(inverse, 0.0) + 2.0 * error), NO_PARALLAX * size, FARTHEST * size)), True


def _mapped_depth(data: Dataset) -> float | None:
    """Return the median depth of some depth maps; None if there are none, or all are empty."""
    mapped = data.with_depth
    maps = [data.depth(mapped[place]) for place in spread(len(mapped), MOST_FRAMES)]
    known = [each[each > 0].numpy() for each in maps if each is not None]
    values = np.concatenate([np.zeros(0, np.float32), *known])
    return float(np.median(values)) if len(values) else None


def depth_ahead(positions: np.ndarray, axes: np.ndarray, point: np.ndarray) -> float:
    """Return the depth of a point [3] before the mean camera."""
    forward = axes.mean(axis=0)
    return float((point - positions.mean(axis=0)) @ forward / np.linalg.norm(forward))


def _meet(positions: np.ndarray, axes: np.ndarray, least: float) -> bool:
    """Return whether the optical axes meet before the cameras, and converge there by ``least`` times their misses."""
    centre = nearest_to_axes(positions, axes)
    if centre is None:
        return False
    depths = np.einsum("vi,vi->v", centre - positions, axes)
    depth, forward = float(np.median(depths)), axes.mean(axis=0)
    if depth <= rounding(positions) or (depths > 0).mean() < IN_FRONT:
        return False
    misses = centre - positions - depths[:, None] * axes
    aside = axes - (axes @ forward)[:, None] * forward / float(forward @ forward)
    return depth * float(np.linalg.norm(aside)) >= least * float(np.linalg.norm(misses))


def _inverse_distance(data: Dataset, positions: np.ndarray, axes: np.ndarray) -> tuple[float, float]:
    """Measure the median inverse depth over pairs of frames, and its standard error; the error is infinite if flow is
    uncertain in all pairs."""
    least = rounding(positions)
    found = np.array(
        [seen for pair in _pairs(data, positions, axes, least) if (seen := _parallax(data, *pair)) is not None]
    )
    if not len(found):
        return 0.0, np.inf
    values, weights = found[np.argsort(found[:, 0], kind="stable")].T
    median = _weighted_median(values, weights)
    scatter = np.abs(values - median)
    order = np.argsort(scatter, kind="stable")
    deviation = 1.48 * _weighted_median(scatter[order], weights[order])
    floor = PIXEL / np.sqrt((weights**2).sum())  # weights are pixels of parallax for each unit of inverse depth
    return median, max(floor, deviation * float(np.sqrt((weights**2).sum()) / weights.sum()))


def _weighted_median(values: np.ndarray, weights: np.ndarray) -> float:
    """Return the median of values [P] in ascending order."""
    return float(values[np.searchsorted(weights.cumsum(), 0.5 * weights.sum()).clip(max=len(values) - 1)])


def _pairs(data: Dataset, positions: np.ndarray, axes: np.ndarray, least: float) -> list[tuple[int, int]]:
    """Pair some frames with others of their instant or, if there are none, of about their time: one whose camera is
    farthest away, and one at the median distance."""
    times = data.times.double().numpy()
    pairs: dict[tuple[int, int], None] = {}
    for index in spread(len(data), MOST_FRAMES):
        apart = np.linalg.norm(positions - positions[index], axis=1)
        similar = axes @ axes[index] > LIKE
        for reach in (AT_ONCE, NEARBY, 1.0):
            others = np.flatnonzero((np.abs(times - times[index]) <= reach) & (apart > least) & similar)
            if len(others):
                order = others[np.argsort(apart[others], kind="stable")]
                pairs.update({(index, int(order[-1])): None, (index, int(order[len(order) // 2])): None})
                break
    return list(pairs)


def _parallax(data: Dataset, one: int, two: int) -> tuple[float, float] | None:
    """Return the median inverse depth of what two frames show, and by how many pixels a unit of it moves the image;
    None if flow between them is uncertain."""
    frames = data[one], data[two]
    if frames[0].image.shape != frames[1].image.shape:
        return None
    flow, certain = measured(*frames)[0]
    if certain.mean() < LEAST_CERTAIN:
        return None
    size = flow_size(frames[0].camera.width, frames[0].camera.height)
    cameras = [scaled_camera(frame.camera, *size) for frame in frames]
    views = [camera.viewmat.double().cpu().numpy() for camera in cameras]
    inverses = [np.linalg.inv(camera.K.double().cpu().numpy()) for camera in cameras]
    change = views[1] @ np.linalg.inv(views[0])
    ends = targets_of(flow.astype(np.float32))[certain] + 0.5
    starts = targets_of(np.zeros_like(flow, dtype=np.float32))[certain] + 0.5
    rays, seen = (
        np.pad(each, ((0, 0), (0, 1)), constant_values=1.0) @ K.T for each, K in zip((starts, ends), inverses)
    )
    far, shift = rays @ change[:3, :3].T, change[:3, 3]
    moves = seen[:, :2] * shift[2] - shift[:2]  # how far a unit of inverse depth takes a ray, and where the ray went
    went = far[:, :2] - seen[:, :2] * far[:, 2:]
    squares = (moves**2).sum(1)
    weight = float(np.sqrt(np.median(squares))) * float(cameras[0].K[0, 0])
    inverse = (moves * went).sum(1)[squares > 0.0] / squares[squares > 0.0]
    return (float(np.median(inverse)), weight) if len(inverse) and weight > 0.0 else None
