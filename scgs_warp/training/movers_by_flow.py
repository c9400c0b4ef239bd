"""Initial points of what moves, in the pose of one instant of a film.

A reconstruction's sparse points lie on what stands still. Without points on a mover, control points and Gaussians begin
beside it, and random ones near the camera explain each photo by itself. Flow to frames shortly before and after gives
each pixel a depth as if it stood still meanwhile, which is about right where the camera moves more than the subject.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..data.dataset import Dataset, spread
from ..geometry.optical_flow import targets_of
from ..geometry.pinhole import pixels_of, ray_of
from ..runtime.progress import progress
from ..runtime.search_tree import search_tree
from ..types import Camera
from .clouds import LEAST_REGION, Cloud, colors_at, strays
from .flow import Flows

CANDIDATES = 12
"""Number of instants that are tried; the one at which most pixels have a plausible depth is taken."""
WIDEST = 0.12
"""Distance from camera to camera, as a share of the distance to the content, up to which flow is followed."""
LEAST_BASELINE = 0.02
"""Distance from camera to camera, as a share of the distance to the content, from which flow gives depth."""
LONGEST_SPAN = 12
"""Largest number of frames over which flow is followed in each direction."""
ENOUGH = 0.5
"""Least number of moving pixels of the chosen instant, as a share of the largest."""
APART = 0.3
"""Largest distance of a pixel from its place as seen from the found point, as a share of the parallax of its
surroundings against what is far away."""
FOLLOWED = (4, 8, 16, 24)
"""Numbers of frames over which flow is followed: afterwards, a point at rest must be where flow leads."""
LEFT = 0.008
"""Distance from where flow leads, as a share of the image's longer side, beyond which a point has moved."""
AROUND_PIXEL, MAJORITY = 9, 0.6
"""Side of the square around a pixel, and the least share of its pixels that must move if the pixel does."""
NEARER, FARTHER = 0.2, 1.1
"""Range of plausible depths, as shares of the depth of the sparse points around the pixel: a mover stands before
them."""
BEFORE, LACKING = 0.8, 0.5
"""Depth below which a point lies before the sparse points around it, as a share of theirs, and the least share of the
moving points for which this holds where a mover has no sparse points."""
AROUND = 3
"""Number of sparse points nearest to a pixel; their median depth is used as that of the pixel's surroundings."""


def flow_cloud(count: int, known: Tensor, data: Dataset, views: list[Camera]) -> Cloud | None:
    """Find up to ``count`` points of the frame in which flow tells most depths.

    Args:
        known: [P, 3] sparse points of the data, normalised.
        views: normalised cameras, on the host.

    Returns:
        None if no frame has a neighbour seen from elsewhere, nothing moves, or ``known`` has points on what moves.
    """
    flows, found = Flows(data, views), []
    candidates = spread(len(data), CANDIDATES + 2)[1:-1]
    with progress(len(candidates), "looking for what moves") as bar:
        for index in candidates:
            seen = _seen(index, known, flows, views)
            if seen is not None and len(seen.points):
                found.append((index, seen))
            bar.advance()
    most = max((int(seen.moves.sum()) for _, seen in found), default=0)
    large = [pair for pair in found if int(pair[1].moves.sum()) >= max(1, ENOUGH * most)]
    # Of a slow mover, a reconstruction has points already.
    if not large or sorted(seen.share_before() for _, seen in large)[len(large) // 2] < LACKING:
        return None
    # A mover that goes with or against the camera looks farther and larger, or nearer and smaller, than it is: at the
    # instant of its median size, depth is least wrong.
    index, seen = sorted(large, key=lambda pair: pair[1].size())[len(large) // 2]
    points, pixels, moves = seen.points, seen.pixels, seen.moves
    chosen = _spread(moves, count)
    colors = colors_at(data[index].image, pixels[chosen].numpy(), flows.size(index))
    return Cloud(points[chosen].float(), colors, moves[chosen], data.entries[index].time)


def _spread(moves: Tensor, count: int) -> Tensor:
    """Choose up to ``count`` points, half of them among those that move."""
    parts = []
    for part in (moves.nonzero()[:, 0], (~moves).nonzero()[:, 0]):
        few = np.linspace(0, len(part) - 1, min(count // 2, len(part))).round().astype(int)
        parts.append(part[torch.from_numpy(few)])
    return torch.cat(parts)


def _moves(index: int, pixels: np.ndarray, flows: Flows) -> np.ndarray:
    """Tell which of the pixels [P, 2] of a frame show what moves, [P] bool: no place at rest is where flow to frames
    further away leads."""
    camera = flows.camera(index)
    seen = [(camera, pixels, np.ones(len(pixels)))]
    for other, targets, certain in flows.followed(index, pixels, FOLLOWED):
        seen.append((other, targets, certain.astype(np.float64)))
    weights = [weight for _, _, weight in seen]
    places = _meeting([ray_of(view, at) for view, at, _ in seen], weights)
    moves = np.zeros(len(pixels), bool)
    for view, at, weight in seen:
        moves |= (weight > 0) & (
            np.linalg.norm(pixels_of(view, places)[0] - at, axis=1) > LEFT * max(camera.width, camera.height)
        )
    return moves


class _Seen(NamedTuple):
    """What flow tells of one frame."""

    points: Tensor
    """[P, 3] float64, normalised."""
    pixels: Tensor
    """[P, 2] (x, y) at the size of the flow."""
    moves: Tensor
    """[P] bool"""

    before: Tensor
    """[P] bool: clearly nearer than the sparse points around it in the image."""

    def share_before(self) -> float:
        """Return the share of the moving points that lie before the sparse points."""
        return float(self.before[self.moves].double().mean())

    def size(self) -> float:
        """Return the median distance of the moving points from their middle; 0 if nothing moves."""
        own = self.points[self.moves]
        return float((own - own.median(0).values).norm(dim=1).median()) if len(own) else 0.0


def _coherent(pixels: np.ndarray, moves: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Keep what moves, [P] bool, where most of the pixels around move, too, in regions of some size: flow errs at
    outlines and where surfaces come into view."""
    columns, rows = pixels.astype(int).T
    seen, moving = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    seen[rows, columns], moving[rows, columns] = 1.0, moves
    share = cv2.blur(moving, (AROUND_PIXEL, AROUND_PIXEL)) / np.maximum(
        cv2.blur(seen, (AROUND_PIXEL, AROUND_PIXEL)), 1e-6
    )
    most = ((share > MAJORITY) & (moving > 0)).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(most)
    large = [part for part in range(1, count) if stats[part, cv2.CC_STAT_AREA] >= LEAST_REGION * most.size]
    return np.isin(labels[rows, columns], large)


def _seen(index: int, known: Tensor, flows: Flows, views: list[Camera]) -> _Seen | None:
    """Find the points that a frame sees; None if its neighbours are not seen from elsewhere."""
    camera = flows.camera(index)
    around = _depths_around(known, camera)
    if around is None:
        return None
    distance = float(np.median(around))
    others = []
    for side in (0, 1):
        path = _path(index, side, distance, flows, views)
        if path is not None:
            vectors, certain = flows.along(path)
            others.append((flows.camera(path[-1]), targets_of(vectors), certain, vectors))
    if not others:
        return None
    sure = np.logical_and.reduce([certain for _, _, certain, _ in others])
    rows, columns = np.nonzero(sure)
    here = np.stack([columns, rows], 1).astype(np.float64)
    seen = [(camera, here), *((other, targets[rows, columns].astype(np.float64)) for other, targets, _, _ in others)]
    points = _meeting([ray_of(view, pixels) for view, pixels in seen])
    plausible = np.ones(len(points), bool)
    baseline = max(float((view.position - camera.position).norm()) for view, _ in seen)
    parallax = float(camera.K[0, 0]) * baseline / around[rows, columns]
    for view, pixels in seen:
        at, depth = pixels_of(view, points)
        plausible &= (depth > 0) & (np.linalg.norm(at - pixels, axis=1) < APART * parallax)
    depth = pixels_of(camera, points)[1] / around[rows, columns]
    plausible &= (depth > NEARER) & (depth < FARTHER)
    moves = _coherent(here[plausible], _moves(index, here[plausible], flows), sure.shape)
    moves[moves] = ~strays(points[plausible][moves])
    values = points[plausible], here[plausible], moves, depth[plausible] < BEFORE
    return _Seen(*(torch.from_numpy(each) for each in values))


def _path(index: int, side: int, distance: float, flows: Flows, views: list[Camera]) -> list[int] | None:
    """Follow the film until the camera has moved enough; None if it does not."""
    path = flows.path(index, LONGEST_SPAN, side)
    start, moved = views[index].position, 0.0
    for length, other in enumerate(path):
        moved = float((views[other].position - start).norm()) / distance
        if moved > WIDEST:
            path = path[: length + 1]
            break
    return path if len(path) > 1 and moved > LEAST_BASELINE else None


def _depths_around(known: Tensor, camera: Camera) -> np.ndarray | None:
    """Return the depth [h, w] of the sparse points around each pixel; None if the camera sees too few."""
    pixels, depths = pixels_of(camera, known.double().numpy())
    inside = (depths > 1e-3) & (pixels > -0.5).all(1) & (pixels < [camera.width - 0.5, camera.height - 0.5]).all(1)
    if inside.sum() < AROUND:
        return None
    rows, columns = np.mgrid[: camera.height, : camera.width]
    where = np.stack([columns, rows], 2).reshape(-1, 2)
    _, nearest = search_tree(pixels[inside]).query(where, k=AROUND)
    return np.median(depths[inside][nearest], 1).reshape(camera.height, camera.width)


def _meeting(rays: list[tuple[np.ndarray, np.ndarray]], weights: list[np.ndarray] | None = None) -> np.ndarray:
    """Return the points [P, 3] with the least sum of squared distances to the rays, each with a weight [P] or 1."""
    matrix, target = 1e-12 * np.eye(3), 0.0
    for number, (position, directions) in enumerate(rays):
        across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
        across = across if weights is None else across * weights[number][:, None, None]
        matrix, target = matrix + across, target + across @ position
    return np.linalg.solve(matrix, np.asarray(target)[..., None])[..., 0]
