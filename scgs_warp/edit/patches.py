"""Patches of the moving surface: the Gaussians nearest to one control point, and how rigidly sets of patches move.

The position of a control point says nothing about how its surroundings turn, and trained control points may lie inside
the body; the Gaussians that they carry show both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

MIN_SHARED = 2
"""Number of Gaussians that two neighbouring patches share at least; where a patch has fewer than ``FEW`` on average, a
single one."""
FEW = 5.0
MIN_SHARE = 0.02
"""Skinning weight below which a Gaussian does not belong to its second patch."""
MAX_GAP = 3.0
"""Largest distance between neighbouring patches at any time, relative to the median, beyond which they are not
connected."""

MIN_PIECE = 4
"""Number of patches below which a piece that shares no Gaussian with the rest belongs to its surroundings, unless it
holds the Gaussians of that many usual patches and goes away from them."""


class Motions(NamedTuple):
    """Rigid motions ``x -> R x + c`` of B bodies from the reference pose to T instants."""

    rotations: np.ndarray
    """[B, T, 3, 3]"""
    shifts: np.ndarray
    """[B, T, 3]"""

    def seen_from(self, base: int, own: int) -> Motions:
        """Return the motion ``x -> Q_t x + s_t`` of one body as seen from another; rotations [T, 3, 3], shifts
        [T, 3]."""
        back = np.swapaxes(self.rotations[base], 1, 2)
        shifts = np.einsum("tij,tj->ti", back, self.shifts[own] - self.shifts[base])
        return Motions(back @ self.rotations[own], shifts)

    def wandering(self) -> tuple[np.ndarray, np.ndarray]:
        """Return A [3 T, 3] and b of a single motion over time: a point x moves by the rows of ``A x - b`` about its
        mean."""
        A = (self.rotations - self.rotations.mean(0)).reshape(-1, 3)
        return A, -(self.shifts - self.shifts.mean(0)).reshape(-1)


class Moments(NamedTuple):
    """Sums over the points of B bodies, from which the best rigid motions and their errors follow. Moments of a union
    of bodies are the sums of theirs."""

    count: np.ndarray
    """[B]"""
    rest: np.ndarray
    """[B, 3] sum of reference positions."""
    posed: np.ndarray
    """[B, T, 3] sums of positions."""
    spread: np.ndarray
    """[B, 3, 3] sum of outer products of reference positions."""
    cross: np.ndarray
    """[B, T, 3, 3] sums of outer products of positions and reference positions."""
    squares: np.ndarray
    """[B, T] sums of squared norms of positions."""

    def take(self, rows: np.ndarray) -> Moments:
        return Moments(*(part[rows] for part in self))

    def plus(self, other: Moments) -> Moments:
        return Moments(*(mine + others for mine, others in zip(self, other)))

    def scaled(self, weights: np.ndarray) -> Moments:
        """Return the moments of bodies whose points count ``weights`` [B] times."""
        return Moments(*(weights.reshape(-1, *[1] * (part.ndim - 1)) * part for part in self))

    def pooled(self, labels: np.ndarray, count: int) -> Moments:
        """Return the moments of ``count`` unions: body b belongs to union ``labels[b]``."""
        ones = np.ones(len(labels))
        member = csr_matrix((ones, (labels, np.arange(len(labels)))), shape=(count, len(labels)))
        return Moments(*((member @ part.reshape(len(labels), -1)).reshape(count, *part.shape[1:]) for part in self))

    def covariance(self) -> np.ndarray:
        """Return the covariances of the reference positions, [B, 3, 3]."""
        mean = self.rest / self.count[:, None]
        return self.spread / self.count[:, None, None] - mean[:, :, None] * mean[:, None]

    def _centred(self) -> np.ndarray:
        return self.cross - self.posed[..., None] * (self.rest / self.count[:, None])[:, None, None]

    def motions(self) -> Motions:
        """Fit the rigid motion of each body (Kabsch)."""
        U, _, Vt = np.linalg.svd(self._centred())
        U[..., 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]
        rotations, mean = U @ Vt, self.rest / self.count[:, None]
        return Motions(rotations, self.posed / self.count[:, None, None] - np.einsum("btij,bj->bti", rotations, mean))

    def errors(self) -> np.ndarray:
        """Return the sum of squared distances from the best rigid motion, averaged over time, [B]."""
        centred = self._centred()
        singular = np.linalg.svd(centred, compute_uv=False)
        fitted = singular[..., 0] + singular[..., 1] + np.sign(np.linalg.det(centred)) * singular[..., 2]
        rest = np.trace(self.spread, axis1=1, axis2=2) - (self.rest**2).sum(1) / self.count
        posed = self.squares - (self.posed**2).sum(2) / self.count[:, None]
        return np.maximum(posed + rest[:, None] - 2.0 * fitted, 0.0).mean(1)

    def errors_under(self, motions: Motions) -> np.ndarray:
        """Return the sum of squared distances of body b from motion k, averaged over time, [B, K]."""
        rotations, shifts = motions
        times = self.squares.shape[1]
        own = self.squares.sum(1) + times * np.trace(self.spread, axis1=1, axis2=2)
        found = own[:, None] + self.count[:, None] * (shifts**2).sum((1, 2))
        flat = rotations.reshape(len(rotations), -1)
        found -= 2.0 * self.cross.reshape(len(own), -1) @ flat.T
        found -= 2.0 * self.posed.reshape(len(own), -1) @ shifts.reshape(len(rotations), -1).T
        found += 2.0 * self.rest @ np.einsum("kti,ktij->kj", shifts, rotations).T
        return np.maximum(found, 0.0) / times


class Patches(NamedTuple):
    """Patches of a scene, their motion and neighbourhood."""

    nodes: np.ndarray
    """[P] control point of each patch, ascending; control points that carry no Gaussian have no patch."""
    moments: Moments
    """Of the P patches, relative to the scene's centre."""
    edges: np.ndarray
    """[E, 2] neighbouring patches, first < second."""
    centre: np.ndarray
    """[3] the origin of the moments."""
    size: float
    """Diagonal of the box around the reference positions."""


def make_patches(tracks: np.ndarray, indices: np.ndarray, weights: np.ndarray) -> Patches:
    """Group Gaussians by their nearest control point.

    Args:
        tracks: [T, N, 3] positions of N > 0 Gaussians at T instants; the first one is the reference.
        indices, weights: [N, K] control points of each Gaussian and their skinning weights.
    """
    order = np.argsort(-weights, axis=1, kind="stable")
    indices, weights = np.take_along_axis(indices, order, 1), np.take_along_axis(weights, order, 1)
    nodes, nearest = np.unique(indices[:, 0], return_inverse=True)
    centre = tracks[0].mean(0)
    moments = _moments(tracks - centre, nearest, len(nodes))
    edges = _edges(moments, nodes, nearest, indices, weights)
    return Patches(nodes, moments, edges, centre, float(np.linalg.norm(np.ptp(tracks[0], axis=0))))


def _moments(tracks: np.ndarray, nearest: np.ndarray, patches: int) -> Moments:
    times, points = tracks.shape[:2]
    member = csr_matrix((np.ones(points), (nearest, np.arange(points))), shape=(patches, points))
    rest = tracks[0]
    outer = [member @ (x[:, :, None] * rest[:, None]).reshape(points, 9) for x in tracks]
    posed = [member @ x for x in tracks]
    squares = [member @ (x**2).sum(1) for x in tracks]
    cross = np.stack(outer, 1).reshape(patches, times, 3, 3)
    return Moments(
        np.asarray(member.sum(1)).reshape(-1), posed[0], np.stack(posed, 1), cross[:, 0].copy(), cross,
        np.stack(squares, 1),
    )  # fmt: skip


def _edges(
    moments: Moments, nodes: np.ndarray, nearest: np.ndarray, indices: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Connect patches that share Gaussians, unless they are far apart at any time."""
    row = np.full(max(int(indices.max()), int(nodes.max())) + 1, -1, np.int64)
    row[nodes] = np.arange(len(nodes))
    second = np.full(len(nearest), -1, np.int64)
    for column in range(indices.shape[1] - 1, 0, -1):
        usable = (row[indices[:, column]] >= 0) & (weights[:, column] > MIN_SHARE)
        second[usable] = row[indices[usable, column]]
    pairs = np.stack([nearest, second], 1)[(second >= 0) & (second != nearest)]
    pairs, shared = np.unique(np.sort(pairs, axis=1), axis=0, return_counts=True)
    pairs = pairs[shared >= (1 if len(nearest) < FEW * len(nodes) else MIN_SHARED)]
    centres = moments.posed / moments.count[:, None, None]
    reach = np.inf
    if len(pairs):
        gaps = ((centres[pairs[:, 0]] - centres[pairs[:, 1]]) ** 2).sum(2)
        reach = MAX_GAP * float(np.median(np.sqrt(gaps.mean(1))))
        pairs = pairs[np.sqrt(gaps.max(1)) <= reach]
    return np.concatenate([pairs, _bridges(centres, moments.count, pairs, reach)])


def _bridges(centres: np.ndarray, counts: np.ndarray, pairs: np.ndarray, reach: float) -> np.ndarray:
    """Connect each piece of fewer than ``MIN_PIECE`` patches to the patch that stays nearest to it, [B, 2]. A body of
    its own is left alone: it holds many Gaussians and is out of ``reach`` at some time.

    Args:
        counts: [P] Gaussians of each patch.
    """
    count = len(centres)
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    piece = connected_components(graph, directed=False)[1]
    sizes = np.bincount(piece)
    if sizes.max() < MIN_PIECE:
        return np.zeros((0, 2), np.int64)
    bodies = np.bincount(piece, counts) >= MIN_PIECE * counts.mean()
    large, found = np.flatnonzero(sizes[piece] >= MIN_PIECE), []
    for label in np.flatnonzero(sizes < MIN_PIECE):
        own = np.flatnonzero(piece == label)
        away = ((centres[own][:, None] - centres[large][None]) ** 2).sum(3)
        here, there = np.unravel_index(away.mean(2).argmin(), away.shape[:2])
        if bodies[label] and away[here, there].max() > reach**2:
            continue
        found.append(sorted((int(own[here]), int(large[there]))))
    return np.array(found, np.int64).reshape(-1, 2)
