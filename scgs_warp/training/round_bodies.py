"""Round bodies among the Gaussians: Gaussians that stay together while they move, as far apart in every direction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from ..ops.sampling import farthest_points
from ..runtime.search_tree import search_tree
from .turn_views import Views

SAMPLE, SAMPLE_OF = 3000, 12_000
"""Largest number of Gaussians of which the bodies are made, and of those from which they are sampled; the others belong
to the body of the nearest of the sample."""
INSTANTS = 24
"""Number of instants at which Gaussians must be close to each other."""
EVERY = 3
"""Of these, only every third tells how far apart two paths are: sampling takes time for each."""
NEAR, TOGETHER = 3.0, 4.0
"""Largest distance of two Gaussians of one body: at one of three instants, and at all, in spacings of the sample."""
FEWEST = 30
"""Smallest number of sampled Gaussians of a body."""
OUTERMOST = 0.97
"""Share of the Gaussians between the bounds of a body, along each axis."""
DIRECTIONS = 400
"""Number of directions from the centre in which the surface is looked for."""
FACING = 0.5
"""Cosine between a direction and that to the camera from which its depth tells where the surface is."""
WITHIN = (0.5, 1.4)
"""Distances from the centre, in radii, between which rendered depth is that of the body."""
SMALLEST = 5.0
"""Smallest radius of a body in the compared images, pixels: smaller ones show no texture."""
FEWEST_VIEWS = 3
"""Smallest number of views that must show the surface in a direction."""
ROUND = 1.8
"""Largest ratio between the largest and the smallest extent of a round surface."""


class RoundBody(NamedTuple):
    """A body whose turns its outline does not show."""

    members: np.ndarray
    """[m] indices of its Gaussians."""
    centres: np.ndarray
    """[T, 3] its centre at each instant, normalised."""
    rotations: np.ndarray
    """[T, 3, 3] its present rotation from the middle instant to each."""
    points: np.ndarray
    """[n, 3] points of its surface at the middle instant, from the centre, normalised."""

    @property
    def radius(self) -> float:
        """Mean distance of the surface from the centre, normalised."""
        return float(np.linalg.norm(self.points, axis=1).mean())


def find_round_bodies(tracks: np.ndarray, solid: np.ndarray, views: Views) -> list[RoundBody]:
    """Find the round bodies, the largest first.

    Args:
        tracks: [T, N, 3] means of the Gaussians at each instant, normalised.
        solid: [N] bool, the Gaussians that are opaque enough to show a surface.
    """
    sampled = np.flatnonzero(solid)
    sampled = sampled[:: max(1, -(-len(sampled) // SAMPLE_OF))]
    if len(sampled) < FEWEST:
        return []
    few = tracks[np.linspace(0, len(tracks) - 1, min(INSTANTS, len(tracks))).round().astype(int)]
    paths = np.ascontiguousarray(few[::EVERY].transpose(1, 0, 2).reshape(tracks.shape[1], -1))
    chosen = farthest_points(torch.from_numpy(paths[sampled]), min(SAMPLE, len(sampled)))
    sampled = sampled[chosen.cpu().numpy()]
    labels = _together(few[:, sampled])
    label_of = labels[search_tree(paths[sampled]).query(paths)[1].reshape(-1)]
    counts = np.bincount(labels)
    bodies = []
    for label in np.argsort(-counts, kind="stable"):
        if counts[label] >= FEWEST:
            body = _round_body(tracks, np.flatnonzero(label_of == label), solid, views)
            if body is not None:
                bodies.append(body)
    return bodies


def _together(tracks: np.ndarray) -> np.ndarray:
    """Label [n] points that are connected by pairs that stay close to each other."""
    middle = tracks[len(tracks) // 2]
    spacing = float(np.median(search_tree(middle).query(middle, k=2)[0][:, 1]))
    instants = (tracks[0], middle, tracks[-1])
    pairs = np.concatenate([_close_pairs(points, NEAR * spacing) for points in instants])
    apart = np.linalg.norm(tracks[:, pairs[:, 0]] - tracks[:, pairs[:, 1]], axis=-1).max(0)
    first, second = pairs[apart < TOGETHER * spacing].T
    count = tracks.shape[1]
    links = coo_matrix((np.ones(len(first)), (first, second)), shape=(count, count))
    return connected_components(links, directed=False)[1]


def _close_pairs(points: np.ndarray, reach: float) -> np.ndarray:
    """Return the pairs [P, 2] of points that are nearer to each other than ``reach``."""
    count = min(17, len(points))
    distances, nearest = search_tree(points).query(points, k=count)
    first = np.repeat(np.arange(len(points)), count)
    near = (distances.reshape(-1) < reach) & (first != nearest.reshape(-1))
    return np.stack([first[near], nearest.reshape(-1)[near]], 1)


def _round_body(tracks: np.ndarray, members: np.ndarray, solid: np.ndarray, views: Views) -> RoundBody | None:
    """Make a body of its Gaussians; None if it is not round."""
    firm = members[solid[members]]
    if len(firm) < FEWEST:
        return None
    low, high = np.quantile(tracks[:, firm], (1.0 - OUTERMOST, OUTERMOST), axis=1)
    centres = 0.5 * (low + high)
    radius = float(np.median(0.5 * (high - low)))
    if _pixels(radius, centres, views) < SMALLEST:
        return None
    rotations = _rotations(tracks[:, firm] - centres[:, None])
    points = _surface(centres, rotations, radius, views)
    if len(points) < DIRECTIONS // 4:
        return None
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T)), 0.0))
    return None if spread[-1] > ROUND * spread[0] else RoundBody(members, centres, rotations, points)


def _pixels(radius: float, centres: np.ndarray, views: Views) -> float:
    """Return the median length of a radius in the views."""
    depths = [views.project(view, centres[instant])[2] for view, instant in enumerate(views.instants)]
    return float(np.median(radius * views.intrinsics[:, 0, 0] / np.array(depths)))


def _rotations(offsets: np.ndarray) -> np.ndarray:
    """Fit the rotation from the middle instant to each, [T, 3, 3], to offsets [T, n, 3] from the centre."""
    middle = offsets[len(offsets) // 2]
    return np.stack([Rotation.align_vectors(there, middle)[0].as_matrix() for there in offsets])


def _surface(centres: np.ndarray, rotations: np.ndarray, radius: float, views: Views) -> np.ndarray:
    """Find points [n, 3] of the surface from rendered depth, at most one in each direction: of all views that face it,
    the median of the distances from the centre."""
    number = np.arange(DIRECTIONS) + 0.5
    polar, azimuth = np.arccos(1.0 - 2.0 * number / DIRECTIONS), np.pi * (1.0 + 5.0**0.5) * number
    directions = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], 1)
    distances = np.full((len(views.instants), DIRECTIONS), np.nan)
    for view, instant in enumerate(views.instants):
        outward = directions @ rotations[instant].T
        places = centres[instant] + radius * outward
        x, y, depth = views.project(view, places)
        eye = views.eye(view) - centres[instant]
        share = views.depth_at(view, x, y) / depth
        share[~np.isfinite(share)] = np.nan  # nothing is rendered there
        there = views.eye(view) + share[:, None] * (places - views.eye(view))
        apart = np.linalg.norm(there - centres[instant], axis=1)
        shown = outward @ eye > FACING * np.linalg.norm(eye)
        shown &= (apart > WITHIN[0] * radius) & (apart < WITHIN[1] * radius)
        distances[view, shown] = apart[shown]
    known = np.isfinite(distances).sum(0) >= FEWEST_VIEWS
    return directions[known] * np.nanmedian(distances[:, known], axis=0)[:, None]
