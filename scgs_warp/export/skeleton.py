"""A moving scene as a skeleton: control points as joints, Gaussians bound to them at rest. World units, float64.

SC-GS's skinning (Eq. 6) of a Gaussian at rest x, ``sum_k w_k (R_k (x - p_k) + p_k + T_k)``, is linear blend skinning: a
joint is at ``p_k + T_k``, turned by ``R_k``, and its inverse bind matrix shifts by ``-p_k``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ..edit import EditSession
from ..edit.pose import compose, own_pose
from ..errors import UserError
from ..gaussians import GaussianParameters
from ..runtime import memory
from ..types import Pose
from .moments import AnimationMoment

JOINT_BYTES = 1600
"""Memory of a control point at a moment while a skeleton is built and written."""


@dataclass(frozen=True)
class Skeleton:
    """Poses of M joints at T moments, and the binding of N Gaussians to them."""

    seconds: np.ndarray
    """[T]"""
    times: np.ndarray
    """[T] scene times in [0, 1]."""
    rest: np.ndarray
    """[M, 3] positions of joints at rest."""
    positions: np.ndarray
    """[T, M, 3]"""
    rotations: np.ndarray
    """[T, M, 4] wxyz, unit, with signs continuous over time."""
    shape_rotations: np.ndarray | None
    """[T, M, 4] rotations of the Gaussians' shapes, if they differ from ``rotations``."""
    log_scales: np.ndarray | None
    """[T, M, 3] changes of the logarithms of scales, if there are any."""
    tints: np.ndarray | None
    """[T, M, 3] changes of the logarithms of colours, if there are any."""
    indices: np.ndarray
    """[N, K] int32"""
    weights: np.ndarray
    """[N, K] rows sum to 1."""
    own_rotations: np.ndarray | None = None
    """[T, M, 4] rotations of the motion, which shading and correctives follow where an edit turns joints further."""
    names: tuple[str, ...] | None = None
    """Names of joints; None: numbers."""
    parents: tuple[int, ...] | None = None
    """Row of each joint's parent, -1: none; None: no joint has one."""
    share: np.ndarray | None = None
    """[N] share of the motion that each Gaussian takes, by a mask; the last joint, which stands still, has the rest of
    its weight. None: there is no mask."""

    def select(self, rows: np.ndarray) -> Skeleton:
        """Restrict the binding to the Gaussians of ``rows`` [N] bool."""
        share = None if self.share is None else self.share[rows]
        return replace(self, indices=self.indices[rows], weights=self.weights[rows], share=share)


def extent_of(points: np.ndarray) -> float:
    """Return the diagonal of the box around 98 % of points [N, 3] along each axis."""
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    return max(float(np.linalg.norm(high - low)), 1e-12)


@torch.no_grad()
def build_skeleton(
    session: EditSession,
    moments: list[AnimationMoment],
    advance: Callable[[], None] | None = None,
    *,
    bound: bool = True,
) -> Skeleton:
    """Build the skeleton of a session's control points under its edit.

    Args:
        moments: moments of the animation.
        advance: called after each moment.
        bound: whether Gaussians are to follow. A mask, by which they follow less, does not concern the control points.

    Raises:
        UserError: the motion is not finite, memory does not suffice, or Gaussians are to follow an edit in a scene with
            a mask: they do not follow edited control points by skinning alone.
    """
    engine, scene = session.engine, session.scene
    count, length = len(engine.rig.positions), len(moments)
    what = f"the motion of {count:,} control points at {length:,} instants"
    memory.require(JOINT_BYTES * count * length, "cpu", what, "give fewer --frames, or a shorter film")
    masked = bound and engine.masked
    poses, own = [], []
    for moment in moments:
        pose, motion = _pose(session, moment, masked)
        poses.append(pose)
        own.append(pose if motion is None else motion)
        if advance is not None:
            advance()
    rest = engine.rig.positions.detach().cpu().double()
    places = torch.stack([rest + pose.translations.detach().cpu().double() for pose in poses]).numpy()
    indices, weights = (part.detach().cpu().numpy() for part in engine.binding)
    weights = weights.astype(np.float64) / weights.sum(axis=1, dtype=np.float64, keepdims=True)
    skeleton = Skeleton(
        np.array([moment.seconds for moment in moments]),
        np.array([moment.time for moment in moments]),
        engine.to_world(rest.numpy()),
        engine.to_world(places),
        _unit([pose.rotations for pose in poses]),
        None if poses[0].shape_rotations is None else _unit([_require(pose.shape_rotations) for pose in poses]),
        None if poses[0].log_scales is None else _stack([_require(pose.log_scales) for pose in poses]),
        None if poses[0].tints is None else _stack([_require(pose.tints) for pose in poses]),
        indices,
        weights,
        None if all(a is b for a, b in zip(own, poses)) else _unit([pose.turns_of_shapes for pose in own]),
    )
    _check_finite(skeleton)
    return _with_rest(skeleton, scene.gaussians) if masked else skeleton


def _check_finite(skeleton: Skeleton) -> None:
    tracks = (
        *(skeleton.positions, skeleton.rotations, skeleton.shape_rotations, skeleton.log_scales),
        *(skeleton.tints, skeleton.own_rotations),
    )
    for track in tracks:
        good = track is None or np.isfinite(track).all(axis=(1, 2))
        if not np.all(good):
            raise _not_finite(float(skeleton.times[int(np.argmin(good))]))


def _not_finite(time: float) -> UserError:
    return UserError(
        f"the control points' motion is not finite at time {time:g}; train again with a lower rate, or put the "
        "previous checkpoint back"
    )


def _pose(session: EditSession, moment: AnimationMoment, masked: bool) -> tuple[Pose, Pose | None]:
    """Return the pose at a moment, and the result of ``own_pose``."""
    engine, edit = session.engine, session.edit
    motion = engine.motion_at(moment.time)
    if not all(value is None or value.isfinite().all() for value in vars(motion.pose).values()):
        raise _not_finite(moment.time)
    bent = engine.bend(edit, moment.time, moment.at, frame=edit.reach)
    if bent is None:
        return motion.pose, None
    if masked:
        raise UserError(
            "--edit: with this run's mask (motion.mask), Gaussians follow handles whole but the motion by a share, "
            "which control points cannot hold; write a film, html, ply-sequence, 4dgs, tracks or graph"
        )
    return compose(motion, bent), own_pose(motion, bent)


def _require(value: Tensor | None) -> Tensor:
    assert value is not None  # all poses of a motion model have the same fields
    return value


def _stack(values: list[Tensor]) -> np.ndarray:
    return torch.stack(values).detach().cpu().double().numpy()


def _unit(rotations: list[Tensor]) -> np.ndarray:
    """Return unit quaternions [T, M, 4] with signs continuous over time, as players interpolate linearly."""
    quats = _stack(rotations)
    return continuous(quats / np.linalg.norm(quats, axis=-1, keepdims=True))


def continuous(quats: np.ndarray) -> np.ndarray:
    """Flip signs of quaternions [T, M, 4] such that they are continuous over time."""
    flips = (quats[1:] * quats[:-1]).sum(axis=2, keepdims=True) < 0
    quats = quats.copy()
    quats[1:] *= np.where(np.cumsum(flips, axis=0) % 2 == 1, -1.0, 1.0)
    return quats


def _with_rest(skeleton: Skeleton, gaussians: GaussianParameters) -> Skeleton:
    """Append a static joint that takes the share of each Gaussian which a mask excludes from the motion."""
    share = gaussians.hyper.detach()[:, -1:].sigmoid().cpu().double().numpy()
    frames, joints = skeleton.positions.shape[:2]
    still = np.zeros((frames, 1, 4))
    still[..., 0] = 1.0
    shapes = skeleton.shape_rotations
    sizes, tints = (
        None if track is None else np.concatenate([track, np.zeros((frames, 1, 3))], axis=1)
        for track in (skeleton.log_scales, skeleton.tints)
    )
    middle = skeleton.rest.mean(axis=0, keepdims=True)
    return replace(
        skeleton,
        rest=np.concatenate([skeleton.rest, middle]),
        positions=np.concatenate([skeleton.positions, np.broadcast_to(middle, (frames, 1, 3))], axis=1),
        rotations=np.concatenate([skeleton.rotations, still], axis=1),
        shape_rotations=None if shapes is None else np.concatenate([shapes, still], axis=1),
        log_scales=sizes,
        tints=tints,
        indices=np.column_stack([skeleton.indices, np.full(len(share), joints, np.int32)]),
        weights=np.column_stack([share * skeleton.weights, 1.0 - share]),
        share=share[:, 0],
    )
