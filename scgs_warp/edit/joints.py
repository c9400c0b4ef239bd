"""Joints between neighbouring parts: the point, and where the motion shows one the axis, about which they turned."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .parts import LEAST_TURN, NARROW_TURN, fit_parts, relative_turns
from .patches import Motions, Patches
from .rotations import from_matrix, logarithm

AXIS_SHARE = 0.8
"""Share of the variance of the relative rotation that its main axis explains at least, if the joint has an axis."""
MISTAKE = math.radians(1.25)
"""Standard deviation of turns between two parts that the motion may show by mistake, radians. Turns of this size
determine a point as well as the boundary's middle does."""
NEAR = 1e-2
"""Weight of the boundary's middle, relative to that of the motion, for the play of a pair. Both thighs turn about one
line, so that a thigh could hang on the other one as on the hips. With this weight, play grows with the turn, and the
thigh hangs on the hips."""
HINGE = 0.1
"""Variance of turns across the main axis, relative to that about it, below which a joint is a hinge."""


class Joint(NamedTuple):
    """Joint of a part with its parent, in the reference pose and the units of the patches."""

    parent: int
    """-1: the part is a root; the joint is then its centre and has no other meaning."""
    point: np.ndarray
    """[3]"""
    axis: np.ndarray | None
    """[3] unit direction about which the motion turned the part most, in the reference pose; None if it shows none."""
    turn: float
    """Largest angle between two instants, radians."""
    play: float
    """Root mean square distance by which the point moves against itself on the two parts, with ``NEAR``."""
    confidence: float
    """0: the motion never bent the joint, and the point is the middle of the boundary; near 1: the motion alone
    determines the point."""


def find_joints(patches: Patches, labels: np.ndarray) -> list[Joint]:
    """Return the joint of each part with its parent. Parts form one tree for each connected piece of the body: of all
    pairs of neighbours, those whose joint has the least play (Kruskal). The root is the part from which the mean
    distance in joints to all Gaussians is least.

    Args:
        labels: [P] part of each patch, from ``find_parts``.
    """
    parts = int(labels.max()) + 1
    pooled, motions = fit_parts(patches.moments, labels)
    ends = labels[patches.edges]
    pairs = np.unique(np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1), axis=0)
    turns = relative_turns(pooled, motions, pairs)
    joints = [_fit(patches, labels, motions, pair, turn) for pair, turn in zip(pairs.tolist(), turns.tolist())]
    order = sorted(range(len(pairs)), key=lambda row: (joints[row].play, *pairs[row].tolist()))
    tree = _spanning(pairs[order].tolist(), parts)
    centres = pooled.rest / pooled.count[:, None] + patches.centre
    found: list[Joint | None] = [None] * parts
    for root, parents in _rooted(tree, pooled.count):
        found[root] = Joint(-1, centres[root], None, 0.0, 0.0, 0.0)
        for child, parent in parents.items():
            row = next(row for row, pair in enumerate(pairs.tolist()) if set(pair) == {child, parent})
            found[child] = joints[row]._replace(parent=parent)
    return [joint for joint in found if joint is not None]


def _fit(patches: Patches, labels: np.ndarray, motions: Motions, pair: list[int], turn: float) -> Joint:
    """Find the point that moves least between the two parts, near the middle of their boundary.

    Seen from the first part, the second moves by ``x -> Q_t x + s_t``. The point minimises the variance of this over
    time, plus its squared distance from the boundary's middle; the latter's weight is the ratio of the variance to the
    boundary's extent, at least ``MISTAKE`` squared. A hinge leaves the position along its axis open: where small turns
    across it put the point beyond the boundary, they are mistakes, and the boundary's middle counts.
    """
    first, second = pair
    seen = motions.seen_from(first, second)
    turned, times = seen.rotations, len(seen.rotations)
    middle, extent = _boundary(patches, labels, pair)
    A, b = seen.wandering()
    b = b - A @ middle
    normal, right = A.T @ A / times, A.T @ b / times
    play2 = float(((A @ np.linalg.lstsq(A, b, rcond=1e-6)[0] - b) ** 2).sum() / times)
    values, axes = np.linalg.eigh(normal)
    values = np.maximum(values, 0.0)
    known = float(values[1])
    prior = max(play2 / extent**2, MISTAKE**2)
    alone = axes.T @ right / np.maximum(values, 1e-300)  # where the motion by itself puts the point
    offset = values * alone / (values + prior)
    if values[0] < HINGE * known and abs(alone[0]) > extent:
        offset[0] = 0.0
    near = values * alone / (values + max(play2 / extent**2, NEAR * known))
    play = math.sqrt(float(((A @ axes @ near - b) ** 2).sum() / times))
    if turn < NARROW_TURN * LEAST_TURN:
        return Joint(-1, middle + patches.centre, None, turn, play, 0.0)
    return Joint(-1, middle + axes @ offset + patches.centre, _axis(turned, motions.rotations[first, 0]), turn, play,
                 known / (known + prior))  # fmt: skip


def _boundary(patches: Patches, labels: np.ndarray, pair: list[int]) -> tuple[np.ndarray, float]:
    """Return the middle of the boundary between two parts, and its root mean square extent."""
    ends = patches.edges[(np.sort(labels[patches.edges], axis=1) == sorted(pair)).all(1)]
    centres = patches.moments.rest / patches.moments.count[:, None]
    middles = centres[ends].mean(1)
    gap = float(np.sqrt(((centres[ends[:, 0]] - centres[ends[:, 1]]) ** 2).sum(1).mean()))
    middle = middles.mean(0)
    return middle, max(gap, float(np.sqrt(((middles - middle) ** 2).sum(1).mean())), 1e-9)


def _axis(turned: np.ndarray, frame: np.ndarray) -> np.ndarray | None:
    """Return the main axis of the relative rotations [T, 3, 3], in the reference pose."""
    U, _, Vt = np.linalg.svd(turned.mean(0))
    middle = U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    vectors = logarithm(from_matrix(turned @ middle.T))
    values, axes = np.linalg.eigh(np.einsum("ti,tj->ij", vectors, vectors))
    if not values[2] > AXIS_SHARE * values.sum():
        return None
    axis = frame @ axes[:, 2]
    return axis if axis[np.abs(axis).argmax()] > 0 else -axis


def _spanning(pairs: list[list[int]], parts: int) -> list[list[int]]:
    """Return the pairs that connect parts not connected by earlier ones."""
    group, kept = list(range(parts)), []
    for first, second in pairs:
        a, b = group[first], group[second]
        if a != b:
            group = [a if label == b else label for label in group]
            kept.append([first, second])
    return kept


def _rooted(tree: list[list[int]], sizes: np.ndarray) -> list[tuple[int, dict[int, int]]]:
    """Return the root of each connected piece, and the parent of every other part in it, parents before children."""
    near: dict[int, list[int]] = {part: [] for part in range(len(sizes))}
    for first, second in tree:
        near[first].append(second)
        near[second].append(first)

    def reach(root: int) -> tuple[dict[int, int], float]:
        parents, depth, queue = {}, {root: 0}, [root]
        for part in queue:  # the list grows
            for other in near[part]:
                if other not in depth:
                    parents[other], depth[other] = part, depth[part] + 1
                    queue.append(other)
        return parents, float(sum(depth[part] * sizes[part] for part in queue))

    found, left = [], set(near)
    while left:
        piece = {min(left), *reach(min(left))[0]}
        root = min(sorted(piece), key=lambda part: reach(part)[1])
        found.append((root, reach(root)[0]))
        left -= piece
    return found
