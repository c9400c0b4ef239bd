"""Motion of Gaussians as piecewise linear segments, each as long as a tolerance allows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..edit.rotations import unit

POSITION = 2e-4
"""Tolerance of positions along each axis, relative to the scene's extent."""
TURN = 3e-4
"""Tolerance of rotations: distance by which the ends of a Gaussian's axes may be off, relative to the scene's extent. A
round Gaussian may turn as it likes."""
COLOR, SCALE = 2.0 / 255.0, 0.02
"""Tolerances of colours, and of the logarithms of scales."""


class Course(NamedTuple):
    """Gaussians over time, world units: what changes, at T moments."""

    seconds: np.ndarray
    """[T] ascending."""
    means: np.ndarray
    """[T, N, 3] float32."""
    quats: np.ndarray
    """[T, N, 4] wxyz."""
    scales: np.ndarray
    """[T, N, 3]"""
    colors: np.ndarray
    """[T, N, 3]"""
    extent: float
    """Size of the scene, to which tolerances refer."""


class Segments(NamedTuple):
    """Segments that begin at one moment. Positions move linearly; all else is constant."""

    frame: int
    """Row of the moment."""
    rows: np.ndarray
    """[R] Gaussians, ascending."""
    starts: np.ndarray
    """[R, 3]"""
    velocities: np.ndarray
    """[R, 3] units per second."""
    quats: np.ndarray
    """[R, 4] wxyz."""
    scales: np.ndarray
    """[R, 3]"""
    colors: np.ndarray
    """[R, 3]"""


def segments(course: Course, every: int) -> Iterator[Segments]:
    """Yield the segments that begin at each moment but the last.

    A segment ends where no line through its start stays within the tolerance of all positions any longer (a swing
    filter), or where rotation, colour or scale would change by more than twice theirs; these have the values of its
    middle.

    Args:
        every: number of moments after which all Gaussians begin a segment anew.
    """
    last = len(course.seconds) - 1
    ends = np.zeros(course.means.shape[1], np.int64)
    for frame in range(last):
        whole = frame % every == 0
        rows = np.arange(len(ends)) if whole else np.flatnonzero(ends <= frame)
        limit = min(last, frame - frame % every + every)
        ends[rows], velocities = _reach(course, frame, limit, rows)
        middle = (frame + ends[rows]) // 2
        yield Segments(
            frame,
            rows,
            course.means[frame, rows].astype(np.float64),
            velocities,
            course.quats[middle, rows],
            course.scales[middle, rows],
            course.colors[middle, rows],
        )


def _reach(course: Course, frame: int, limit: int, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the last moment [R] to which a segment from ``frame`` reaches, at least the next one and at most
    ``limit``, and its velocity [R, 3]."""
    start = course.means[frame, rows].astype(np.float64)
    slack = POSITION * course.extent
    ends, velocities = np.full(len(rows), frame + 1), np.zeros((len(rows), 3))
    low, high = np.full((len(rows), 3), -np.inf), np.full((len(rows), 3), np.inf)
    alive = np.arange(len(rows))
    for later in range(frame + 1, limit + 1):
        span = course.seconds[later] - course.seconds[frame]
        moved = course.means[later, rows[alive]] - start[alive]
        lower = np.maximum(low[alive], (moved - slack) / span)
        upper = np.minimum(high[alive], (moved + slack) / span)
        good = (lower <= upper).all(axis=1) & (_change(course, frame, later, rows[alive]) <= 2.0)
        good |= later == frame + 1
        alive, lower, upper = alive[good], lower[good], upper[good]
        low[alive], high[alive], ends[alive] = lower, upper, later
        velocities[alive] = 0.5 * (lower + upper)
        if not len(alive):
            break
    return ends, velocities


def _change(course: Course, first: int, second: int, rows: np.ndarray) -> np.ndarray:
    """Return the greatest change of rotation, colour or scale between two moments, [R], in units of the tolerance."""
    a, b = unit(course.quats[first, rows]), unit(course.quats[second, rows])
    chord = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    scales = course.scales[first, rows]
    turn = 2.0 * chord * (scales.max(axis=1) - scales.min(axis=1)) / (TURN * course.extent)
    color = np.abs(course.colors[second, rows] - course.colors[first, rows]).max(axis=1) / COLOR
    scale = np.abs(np.log(course.scales[second, rows] / scales)).max(axis=1) / SCALE
    return np.maximum(np.maximum(turn, color), scale)
