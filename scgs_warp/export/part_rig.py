"""A moving scene as a rig of its parts: named joints in a tree, and Gaussians bound to them at time 0. World units.

The weights of a Gaussian are those of its control points, summed by part; the motion of a part is the rigid one that
comes closest to its Gaussians. Fitting both in turn to the tracks (smooth skinning decomposition) lowers the error
little, and leaves weights that are less smooth for posing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from ..edit import EditSession
from ..edit.rotations import from_matrix, rotate
from ..edit.skeleton import Skeleton as Parts
from ..errors import UserError
from ..runtime import memory
from ..types import Gaussians
from .finite import finite_rows, select_gaussians
from .moments import AnimationMoment, posed_gaussians
from .skeleton import Skeleton, continuous, extent_of

WIDTH = 4
"""Number of parts per Gaussian: what every player of glTF supports."""
PRIOR = 1e-4
"""Weight of the previous moment's rotation, relative to the spread of a part's Gaussians: it decides what they do not,
such as the twist of a line."""


TRACK_BYTES = 64
"""Memory of a Gaussian at a moment while a rig is built."""


class RigLoss(NamedTuple):
    """Distances between Gaussians that follow the parts and those that follow the whole motion, at all moments,
    relative to the scene's extent (:func:`~scgs_warp.export.skeleton.extent_of`)."""

    mean: float
    most: float
    """95 % are at most this far off."""

    def __str__(self) -> str:
        return (
            f"blending parts is off by {100 * self.mean:.2f} % of the scene's extent in the mean, by at most "
            f"{100 * self.most:.2f} % for 95 of 100 Gaussians"
        )


class Rig(NamedTuple):
    """Gaussians at time 0, their skeleton of parts, and what it loses."""

    gaussians: Gaussians
    """Activated, with their mean colours over all moments."""
    skeleton: Skeleton
    loss: RigLoss


def build_rig(
    session: EditSession,
    parts: Parts,
    moments: list[AnimationMoment],
    rows: np.ndarray,
    advance: Callable[[], None] | None = None,
) -> Rig:
    """Build the rig of a scene's parts under a session's edit.

    Args:
        parts: of the session's control points.
        moments: moments of the animation.
        rows: [N] bool, Gaussians to use.
        advance: called after each moment.

    Raises:
        UserError: no Gaussian is finite at all moments, or memory does not suffice.
    """
    scene, frames = session.scene, []
    need, what = TRACK_BYTES * len(rows) * len(moments), f"--skeleton parts of {len(moments):,} instants"
    memory.require(need, "cpu", what, "give fewer --frames, or a shorter film")
    with torch.no_grad():
        start = scene.gaussians_at(0.0)
        rows = rows & finite_rows(start)
        for moment in moments:
            posed = posed_gaussians(scene, session, moment)
            rows &= finite_rows(posed)
            frames.append((posed.means.cpu().numpy(), posed.sh_dc.cpu().numpy()))
            if advance is not None:
                advance()
    if not rows.any():
        raise UserError("no Gaussian of the scene is finite at all moments; train again with a lower rate")
    start = select_gaussians(start, rows)
    colors = sum(sh_dc[rows].astype(np.float64) for _, sh_dc in frames) / len(frames)
    tracks, rest = [means[rows] for means, _ in frames], start.means.double().numpy()
    nodes, shares = (value.detach().cpu().numpy()[rows] for value in session.engine.binding)
    indices, weights = part_weights(nodes, shares, parts.owners())
    rotations, shifts = _rigid_motions(tracks, rest, indices, weights, len(parts.parts))
    joints = np.array([part.joint for part in parts.parts])
    row_of = {name: row for row, name in enumerate(parts.names)}
    skeleton = Skeleton(
        np.array([moment.seconds for moment in moments]),
        np.array([moment.time for moment in moments]),
        joints,
        rotate(rotations, joints) + shifts,
        rotations,
        None,
        None,
        None,
        indices,
        weights,
        names=parts.names,
        parents=tuple(-1 if part.parent is None else row_of[part.parent] for part in parts.parts),
    )
    loss = _loss(tracks, rest, skeleton)
    return Rig(replace(start, sh_dc=torch.from_numpy(colors).float()), skeleton, loss)


def part_weights(indices: np.ndarray, weights: np.ndarray, owners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum skinning weights over the control points of each part.

    Args:
        indices, weights: [N, K] control points of every Gaussian, and their weights.
        owners: [M] part of each control point.

    Returns:
        The ``WIDTH`` parts of greatest weight, [N, WIDTH] int32, and their weights, which sum to 1.
    """
    labels = owners[indices]
    same = labels[:, :, None] == labels[:, None]
    repeated = np.tril(same, -1).any(axis=2)
    totals = np.where(repeated, 0.0, (same * weights[:, None].astype(np.float64)).sum(axis=2))
    order = np.argsort(-totals, axis=1, kind="stable")[:, :WIDTH]
    parts, shares = np.take_along_axis(labels, order, 1), np.take_along_axis(totals, order, 1)
    return parts.astype(np.int32), shares / np.maximum(shares.sum(axis=1, keepdims=True), 1e-30)


def _rigid_motions(
    tracks: list[np.ndarray], rest: np.ndarray, indices: np.ndarray, weights: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions [T, P, 4], continuous over time, and shifts [T, P, 3] of the motions ``x -> R x + c`` that
    come closest to the Gaussians of each part, each counted by the square of its weight."""
    matrices, shifts = np.tile(np.eye(3), (len(tracks), count, 1, 1)), np.zeros((len(tracks), count, 3))
    for part in range(count):
        share = np.where(indices == part, weights, 0.0).sum(axis=1) ** 2
        rows = np.flatnonzero(share > 0)
        if not len(rows):
            continue
        share, points, before = share[rows] / share[rows].sum(), rest[rows], np.eye(3)
        centre = share @ points
        arms = share[:, None] * (points - centre)
        least = PRIOR * float((arms * (points - centre)).sum()) + 1e-30
        for frame, track in enumerate(tracks):
            U, _, Vt = np.linalg.svd(track[rows].astype(np.float64).T @ arms + least * before)
            U[:, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))
            before = matrices[frame, part] = U @ Vt
            shifts[frame, part] = share @ track[rows] - before @ centre
    return continuous(from_matrix(matrices)), shifts


def _loss(tracks: list[np.ndarray], rest: np.ndarray, skeleton: Skeleton) -> RigLoss:
    extent, off = extent_of(rest), []
    for frame, track in enumerate(tracks):
        arms = rest[:, None] - skeleton.rest[skeleton.indices]
        moved = rotate(skeleton.rotations[frame][skeleton.indices], arms) + skeleton.positions[frame][skeleton.indices]
        blended = (skeleton.weights[..., None] * moved).sum(axis=1)
        off.append((np.linalg.norm(blended - track, axis=1) / extent).astype(np.float32))
    return RigLoss(float(np.mean(off)), float(np.quantile(off, 0.95)))
