"""Bands of skin at joints, which turn half with each of two parts and are not parts themselves.

If a joint bends far, the skin around it is wide enough to look like a part between two others. Such a band is no larger
than either part. It turns about the same point about which the two parts turn against each other, by a share of the
same angle. A bone between two others has a joint at either end instead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .patches import Moments, Motions

MOST_DETOUR = 1.15
"""Sum of the angles by which a band turns against its two parts, at most, relative to their angle to each other."""
MOST_WANDER = 0.5
"""Distance by which the joint of the two parts moves against either of them when the band takes it along, at most,
relative to the distance by which the band's own points move."""
RIDGE = 1e-2
"""Weight of the band's centre in the position of the joint, relative to the motion: a hinge leaves the position along
its axis open."""


class Band(NamedTuple):
    """A band and the two parts between which it lies."""

    part: int
    first: int
    second: int


def find_band(
    moments: Moments,
    motions: Motions,
    pairs: np.ndarray,
    turns: Callable[[np.ndarray], np.ndarray],
) -> Band | None:
    """Return a band of skin among parts, that with the fewest points; None if there is none.

    Args:
        moments, motions: of the parts.
        pairs: [E, 2] neighbouring parts.
        turns: returns the largest angles [E] between the parts of pairs [E, 2].
    """
    near: dict[int, list[int]] = {}
    for first, second in pairs.tolist():
        near.setdefault(first, []).append(second)
        near.setdefault(second, []).append(first)
    for part in sorted(near, key=lambda part: (moments.count[part], part)):
        around = sorted(near[part])
        ends = np.array([(a, b) for a in around for b in around if a < b]).reshape(-1, 2)
        if not len(ends):
            continue
        whole, one, other = (turns(each) for each in (ends, _beside(ends[:, 0], part), _beside(ends[:, 1], part)))
        detours = (one + other) / np.maximum(whole, 1e-9)
        for row in np.argsort(detours, kind="stable").tolist():
            if detours[row] > MOST_DETOUR:
                break
            first, second = ends[row].tolist()
            if moments.count[part] > min(moments.count[first], moments.count[second]):
                continue
            if max(_wander(moments, motions, part, *pair) for pair in ((first, second), (second, first))) < MOST_WANDER:
                return Band(part, first, second)
    return None


def without_band(labels: np.ndarray, errors: np.ndarray, band: Band) -> np.ndarray:
    """Give each patch of a band to the one of its two parts whose motion explains it better.

    Args:
        labels: [P] part of each patch.
        errors: [P, K] error of each patch under the motion of each part.
    """
    nearer = np.where(errors[:, band.first] <= errors[:, band.second], band.first, band.second)
    return np.where(labels == band.part, nearer, labels)


def _beside(parts: np.ndarray, part: int) -> np.ndarray:
    return np.stack([parts, np.full(len(parts), part)], 1)


def _wander(moments: Moments, motions: Motions, part: int, base: int, end: int) -> float:
    """Return by how much the joint of ``base`` and ``end`` moves against ``base`` if ``part`` takes it along, relative
    to what the points of ``part`` move."""
    centre = moments.rest[part] / moments.count[part]
    A, b = motions.seen_from(base, end).wandering()
    normal = A.T @ A
    ridge = RIDGE * float(np.linalg.eigvalsh(normal)[1]) + 1e-12
    joint = centre + np.linalg.solve(normal + ridge * np.eye(3), A.T @ (b - A @ centre))
    A, b = motions.seen_from(base, part).wandering()
    spread = moments.take(np.array([part])).covariance()[0]
    moved = float(((A @ centre - b) ** 2).sum() + np.trace(A @ spread @ A.T))
    return float(np.sqrt(((A @ joint - b) ** 2).sum() / max(moved, 1e-24)))
