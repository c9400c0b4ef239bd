"""Turns of a round body, found by comparing what the views show at each point of its surface.

The outline of a ball does not tell how far it turns, and its texture leads gradients only by a fraction of its own
wavelength: training from a motion without turns ends with a blurred texture. But three numbers describe the turn of a
short window of instants, so that all of them can be tried. The turn that is right lets each point of the surface have
one colour in all views of the window.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from .round_bodies import RoundBody
from .turn_views import Views
from .turn_windows import STRIDE, WINDOW, at_instants, integrated, steadiest, tried_turns, window_starts

FASTEST, STEP = 7.5, 1.5
"""Largest turn per instant that is tried, and the distance between two that are tried, degrees."""
EVIDENCE = 60.0
"""Weight of the logarithm of a window's residual against changes of the turn (``turn_windows.steadiest``)."""
LONG = 24
"""Number of instants of the windows by which the turns are refined."""
FINE = (0.6, 0.3)
"""Steps of the refinement in degrees per instant, one round each."""
FACING = 0.3
"""Cosine between a normal and the direction to the camera from which a point is seen well."""
BEHIND = 0.5
"""Depth in radii by which a point may lie behind the rendered surface and be seen."""
CLEARER = 0.95
"""Largest residual, relative to that without turns, with which turns are believed. It is measured at points from which
they were not found."""


class Turns(NamedTuple):
    """Turns of a body about its centre that are added to its motion."""

    rotations: np.ndarray
    """[T, 3, 3] at each instant; the identity at the middle one."""
    clearer: float
    """Residual at points from which the turns were not found, relative to that without turns."""


class Surface:
    """Points of a body's surface and what the views show there."""

    def __init__(self, body: RoundBody, views: Views, offsets: np.ndarray) -> None:
        """``offsets`` [T, n, 3] are those of the points from the centre at each instant, normalised."""
        self.views, self.centres, self.radius, self.offsets = views, body.centres, body.radius, offsets

    def seen(self, view: int, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how well the points are seen, [H, n], and their colours, [H, n, 3], after each of ``rotations``
        [H, 3, 3] about the centre."""
        views, instant = self.views, self.views.instants[view]
        turned = np.einsum("hij,nj->hni", rotations, self.offsets[instant])
        eye = views.eye(view) - self.centres[instant]
        facing = turned @ (eye / np.linalg.norm(eye)) / np.maximum(np.linalg.norm(turned, axis=-1), 1e-12)
        x, y, depth = views.project(view, turned + self.centres[instant])
        shown = depth < views.depth_at(view, x, y) + BEHIND * self.radius
        colors = views.color_at(view, x, y)
        return np.clip(facing - FACING, 0.0, None) * shown, colors

    def residual(self, views: range, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compare the views' colours at each point.

        Args:
            rotations: [v, H, 3, 3] for each view and each of H turns.

        Returns:
            Sum of the squared differences from the mean colour of a point, [H], and of the squared colours, [H]. The
            mean colour of each view is taken off both, as light changes it.
        """
        samples = [self.seen(view, rotations[row]) for row, view in enumerate(views)]
        weights = np.stack([weight for weight, _ in samples])[..., None]
        colors = np.stack([color for _, color in samples])
        colors = colors - _mean(weights, colors, 2)
        several = (weights > 0).sum(0) > 1
        apart = (weights * (colors - _mean(weights, colors, 0)) ** 2).sum(0)
        return (several * apart).sum((1, 2)), (several * (weights * colors**2).sum(0)).sum((1, 2))


def find_turns(body: RoundBody, views: Views) -> Turns | None:
    """Find the turns of a body; None if there are fewer than ``LONG`` instants, or none is believed."""
    if views.count < LONG:
        return None
    offsets = np.einsum("tij,nj->tni", body.rotations, body.points)
    halves = [Surface(body, views, offsets[:, half::2]) for half in range(2)]
    found = _search(halves[0], views)
    clearer = _clearer(halves[1], found)
    if clearer > 1.0:  # most bodies do not turn: this spares them half of the search
        return None
    clearer = 0.5 * (clearer + _clearer(halves[0], _search(halves[1], views)))
    if clearer > CLEARER:
        return None
    rates = _refined(Surface(body, views, offsets), found)
    if np.linalg.norm(rates, axis=1).max() > np.radians(FASTEST + STEP):
        return None
    rotations = integrated(rates)
    return Turns(rotations @ rotations[views.count // 2].T, clearer)


def _clearer(surface: Surface, rates: np.ndarray) -> float:
    """Return the residual of turns per instant, [T - 1, 3], relative to that without turns."""
    starts = window_starts(surface.views.count, WINDOW)
    still = _cost(surface, starts, WINDOW, integrated(0.0 * rates))
    return _cost(surface, starts, WINDOW, integrated(rates)) / max(still, 1e-12)


def _search(surface: Surface, views: Views) -> np.ndarray:
    """Return the turn per instant, [T - 1, 3] radians: of all turns that are constant in each window, those with small
    residuals that change little from window to window."""
    rates = tried_turns(FASTEST, STEP)
    starts, costs = window_starts(views.count, WINDOW), []
    for start in starts:
        window = views.within(start, WINDOW)
        since = views.instants[window.start : window.stop] - (start + 0.5 * (WINDOW - 1))
        rotations = Rotation.from_rotvec((since[:, None, None] * rates).reshape(-1, 3)).as_matrix()
        apart, total = surface.residual(window, rotations.reshape(len(window), len(rates), 3, 3))
        costs.append(EVIDENCE * np.log(np.maximum(apart / np.maximum(total, 1e-12), 1e-6)))
    middles = np.array(starts) + 0.5 * (WINDOW - 1)
    return at_instants(middles, rates[steadiest(costs, rates)], views.count)


def _cost(surface: Surface, starts: list[int], length: int, rotations: np.ndarray) -> float:
    """Return the residual of rotations [T, 3, 3] over the windows of ``length`` instants at ``starts``."""
    apart = total = 0.0
    for start in starts:
        window = surface.views.within(start, length)
        of_views = rotations[surface.views.instants[window.start : window.stop]]
        off, all_of_it = surface.residual(window, of_views[:, None])
        apart, total = apart + float(off[0]), total + float(all_of_it[0])
    return apart / max(total, 1e-12)


def _refined(surface: Surface, rates: np.ndarray) -> np.ndarray:
    """Improve turns per instant, [T - 1, 3], step by step over long windows, in which errors add up."""
    count = len(rates) + 1
    knots = np.linspace(0.5 * WINDOW, count - 1 - 0.5 * WINDOW, max(2, round((count - WINDOW) / STRIDE) + 1))
    values = np.stack([np.interp(knots, np.arange(count - 1) + 0.5, rates[:, axis]) for axis in range(3)], 1)
    for step in np.radians(FINE):
        for knot, middle in enumerate(knots):
            first = int(min(max(0, middle - LONG), count - LONG))
            starts = [start for start in window_starts(count, LONG) if first <= start <= middle + STRIDE]
            best = _cost(surface, starts, LONG, integrated(at_instants(knots, values, count)))
            for axis in range(3):
                for change in (step, -step):
                    while True:
                        tried = values.copy()
                        tried[knot, axis] += change
                        cost = _cost(surface, starts, LONG, integrated(at_instants(knots, tried, count)))
                        if cost > best - 1e-5:
                            break
                        values, best = tried, cost
    return at_instants(knots, values, count)


def _mean(weights: np.ndarray, values: np.ndarray, axis: int) -> np.ndarray:
    """Return the weighted mean over an axis, which is kept."""
    total = np.maximum(weights.sum(axis, keepdims=True), 1e-6)
    return (weights * values).sum(axis, keepdims=True) / total
