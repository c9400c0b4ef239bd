"""Turns over time from windows of instants: each window judges turns that are constant in it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

WINDOW, STRIDE = 12, 6
"""Number of instants of a window in which the turn is constant, and from one window to the next."""
STEADY = 1.5
"""Change of the turn per instant from one window to the next that counts as one unit, degrees."""


def window_starts(count: int, length: int) -> list[int]:
    """Return the first instants of windows of ``length`` that cover ``count`` instants, ``STRIDE`` apart."""
    starts = list(range(0, count - length + 1, STRIDE))
    return starts if starts[-1] == count - length else [*starts, count - length]


def tried_turns(fastest: float, step: float) -> np.ndarray:
    """Return the rotation vectors [H, 3] of up to ``fastest`` degrees per instant, ``step`` apart, in radians."""
    count = int(fastest / step + 1e-6)
    axis = np.radians(step * np.arange(-count, count + 1))
    turns = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return turns[np.linalg.norm(turns, axis=1) < np.radians(fastest) + 1e-6]


def steadiest(costs: list[np.ndarray], turns: np.ndarray) -> list[int]:
    """Choose one of ``turns`` [H, 3] for each window: those that together cost least and change little.

    Args:
        costs: [H] for each window; a change of ``STEADY`` costs 0.5.
    """
    change = 0.5 * ((turns[:, None] - turns) ** 2).sum(-1) / np.radians(STEADY) ** 2
    best, came_from = costs[0], []
    for cost in costs[1:]:
        through = best[:, None] + change
        came_from.append(through.argmin(0))
        best = through.min(0) + cost
    path = [int(best.argmin())]
    for previous in reversed(came_from):
        path.append(int(previous[path[-1]]))
    return path[::-1]


def at_instants(middles: np.ndarray, turns: np.ndarray, count: int) -> np.ndarray:
    """Interpolate turns per instant [W, 3] at the middles of windows, [count - 1, 3]."""
    steps = np.arange(count - 1) + 0.5
    return np.stack([np.interp(steps, middles, turns[:, axis]) for axis in range(3)], 1)


def integrated(turns: np.ndarray) -> np.ndarray:
    """Return the rotation at each instant, [T, 3, 3], from the turn between neighbouring ones, [T - 1, 3]."""
    rotations = [np.eye(3)]
    for turn in Rotation.from_rotvec(turns).as_matrix():
        rotations.append(turn @ rotations[-1])
    return np.stack(rotations)
