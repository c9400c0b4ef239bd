"""Tracks of points through the clouds of a film: from cloud to cloud, each point goes with the tracked ones around it.
All sides of a mover are thus gathered in one pose.

Flow and depth tell where the visible points of a cloud are at the next one. A point that is hidden then follows the
visible ones nearest to it, as a rigid body.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..runtime.progress import progress
from ..runtime.search_tree import search_tree
from ..seeding import Purpose, generator
from .clouds import Cloud
from .registration import Registration

AROUND = 16
"""Number of tracked points that carry a point."""
FEWEST = 32
"""Least number of tracked points between two clouds."""
OUTLIERS = 3.0
"""Factor on the median difference from the common motion of the points around, beyond which a track is dropped."""
NEAR = 0.1
"""Distance to the tracked points around, in sizes of the mover, at which a step of a track is half as sure."""
LEAST_SURE = 0.15
"""Least weight in the pose of the first cloud with which a point of another is taken there."""
STILL = 1.0
"""Least distance, in units of ``NEAR``, that a point must go. Those that go less do not move after all."""
SURE_AGAIN = 0.9
"""Largest weight of a place near those that an image shows."""
FRESH = 2.0
"""Least distance to the points taken before, in distances between neighbouring points of the first cloud."""


class Tracks(NamedTuple):
    """Points of one cloud, followed through all."""

    places: Tensor
    """[C, P, 3] at the time of each cloud."""
    weights: Tensor
    """[C, P] in [0, 1]: how sure a place is; 0 beyond a cloud without tracks."""

    def of(self, chosen: Tensor) -> Tracks:
        """Return the tracks of some of the points."""
        return Tracks(self.places[:, chosen], self.weights[:, chosen])

    def to(self, device: torch.device) -> Tracks:
        """Return the tracks on a device."""
        return Tracks(self.places.to(device), self.weights.to(device))


def gather(
    clouds: list[Cloud],
    start: int,
    count: int,
    seed: int,
    registration: Registration | None = None,
) -> tuple[Cloud | None, Tracks | None]:
    """Carry the points of all clouds to the pose of cloud ``start``, so that surfaces hidden then are there, too.

    Args:
        count: largest number of points.
        registration: finds points in images far away in time.

    Returns:
        The points of the cloud and those of others that lie beside them, the nearest in time first; and their tracks,
        if the clouds have any. None if tracks show that nothing moves.
    """
    first = clouds[start]
    middle = first.points.median(0).values
    unit = NEAR * max(float((first.points - middle).norm(dim=1).median()), 1e-6)

    def followed(number: int) -> Tracks | None:
        seen = None if registration is None else functools.partial(registration.places, clouds[number])
        return follow(clouds[number].points, number, clouds, unit, seen)

    tracks = followed(start)
    if tracks is None:
        return first, None
    own = first.points.double().numpy()
    spacing = FRESH * float(np.median(search_tree(own).query(own, k=2)[0][:, 1]))
    points, colors, places, weights = [first.points], [first.colors], [tracks.places], [tracks.weights]
    others = sorted(range(len(clouds)), key=lambda each: abs(each - start))[1:]
    with progress(len(others), "tracks of what moves") as bar:
        for number in others:
            found = followed(number)
            assert found is not None, "some cloud has tracks"
            there = found.places[start].double().numpy()
            apart = search_tree(torch.cat(points).double().numpy()).query(there)[0]
            fresh = np.flatnonzero((found.weights[start].numpy() > LEAST_SURE) & (apart > spacing))
            cells = np.floor(there[fresh] / max(spacing, 1e-9)).astype(np.int64)
            kept = torch.from_numpy(fresh[np.unique(cells, axis=0, return_index=True)[1]])
            points.append(found.places[start][kept])
            colors.append(clouds[number].colors[kept])
            places.append(found.places[:, kept])
            weights.append(found.weights[:, kept])
            bar.advance()
    gathered, tracks = torch.cat(points), Tracks(torch.cat(places, 1), torch.cat(weights, 1))
    sure = tracks.weights > LEAST_SURE
    if int(sure.sum(0).max()) < 2:
        return first, None
    some = (((tracks.places - gathered).norm(dim=2) * sure).amax(0) > STILL * unit).nonzero()[:, 0]
    if not len(some):
        return None, None
    some = some[torch.randperm(len(some), generator=generator(seed, Purpose.MOVING_POINTS, start))[:count]]
    moves = torch.ones(len(some), dtype=torch.bool)
    everywhere = Cloud(gathered[some], torch.cat(colors)[some], moves, first.time)
    return everywhere, tracks.of(some)


def follow(
    points: Tensor,
    start: int,
    clouds: list[Cloud],
    unit: float,
    seen: Callable[[float, np.ndarray], np.ndarray] | None = None,
) -> Tracks | None:
    """Follow points [P, 3] of cloud ``start`` through all clouds; None if no cloud has tracks.

    Args:
        unit: distance to the tracked points around at which a step is half as sure.
        seen: returns where images show the points at a time, [P, 3], given the expected places; NaN where none does.
    """
    if all(cloud.later is None for cloud in clouds):
        return None
    places = torch.zeros(len(clouds), len(points), 3, dtype=torch.float64)
    weights = torch.zeros(len(clouds), len(points), dtype=torch.float64)
    places[start], weights[start] = points.double(), 1.0
    for numbers in (range(start, len(clouds) - 1), range(start, 0, -1)):
        for number in numbers:
            ahead = numbers.step > 0
            pairs = _pairs(clouds[number if ahead else number - 1])
            if pairs is None:
                break
            here, there = pairs if ahead else pairs[::-1]
            following = number + numbers.step
            moved, near = _carried(places[number].numpy(), here, there, unit)
            sure = weights[number].numpy() * near
            if seen is not None:
                moved, sure = _corrected(moved, sure, seen(clouds[following].time, moved), unit)
            places[following], weights[following] = torch.from_numpy(moved), torch.from_numpy(sure)
    return Tracks(places.float(), weights.float())


def _pairs(cloud: Cloud) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the tracked points of a cloud, and where they are at the next one, each [Q, 3], without outliers; None if
    there are too few."""
    if cloud.later is None:
        return None
    known = cloud.later.isfinite().all(1)
    return _agreeing(cloud.points[known].double().numpy(), cloud.later[known].double().numpy())


def _corrected(expected: np.ndarray, sure: np.ndarray, seen: np.ndarray, unit: float) -> tuple[np.ndarray, np.ndarray]:
    """Move expected places [P, 3] as the places that images show, those farther from these less; return how sure they
    are then, [P]."""
    known = np.isfinite(seen).all(1)
    pairs = _agreeing(expected[known], seen[known])
    if pairs is None:
        return expected, sure
    moved, again = _carried(expected, *pairs, unit)
    return expected + again[:, None] * (moved - expected), np.maximum(sure, SURE_AGAIN * again)


def _agreeing(here: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return points and where they are later, each [Q, 3], without outliers; None if there are too few."""
    if len(here) < FEWEST:
        return None
    moves = there - here
    nearest = search_tree(here).query(here, k=AROUND)[1]
    apart = np.linalg.norm(moves - np.median(moves[nearest], axis=1), axis=1)
    kept = apart <= OUTLIERS * np.median(apart) + 1e-9
    return (here[kept], there[kept]) if kept.sum() >= FEWEST else None


def _carried(points: np.ndarray, here: np.ndarray, there: np.ndarray, unit: float) -> tuple[np.ndarray, np.ndarray]:
    """Carry points [P, 3] by the rigid motions nearest to those of the tracked points around; return how sure it is,
    [P]."""
    distances, nearest = search_tree(here).query(points, k=AROUND)
    weights = np.exp(-np.square(distances / np.maximum(distances[:, -1:], 1e-12)) * 2.0)
    weights /= weights.sum(1, keepdims=True)
    one, two = here[nearest], there[nearest]
    middle, target = (np.einsum("pk,pkc->pc", weights, each) for each in (one, two))
    products = np.einsum("pk,pki,pkj->pij", weights, two - target[:, None], one - middle[:, None])
    u, _, vt = np.linalg.svd(products)
    signs = np.ones((len(points), 3))
    signs[:, 2] = np.sign(np.linalg.det(u @ vt))
    turned = np.einsum("pij,pj,pjk->pik", u, signs, vt)
    moved = np.einsum("pij,pj->pi", turned, points - middle) + target
    return moved, 1.0 / (1.0 + np.square(distances[:, 0] / unit))
