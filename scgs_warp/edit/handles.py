"""Handles, their targets, and the goals and anchors that the solver gets from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from ..errors import UserError
from .field_reader import FieldReader, check_record
from .graph import ControlGraph
from .rigid_groups import RigidGroups
from .rotations import angle, conjugate, multiply, power, rigid_fit, rotate, to_matrix, unit
from .solver import Anchors

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Lasting = Literal["motion", "frame", "fade"]

ONE_FRAME = 5e-3
"""Largest distance from a handle's time, in scene time, at which a one-frame edit still shows if the film's step is
unknown."""
HALFWAY_STIFFNESS = 10.0
"""Stiffness of a fading handle at half strength. The handle holds its nodes less firmly as its strength goes to 0, so
that they do not jump when it releases them."""
MIN_STIFFNESS, MAX_STIFFNESS = 1e-6, 1e6
"""Limits of a stiffness."""
MIN_NODES_FOR_FRAME = 4
"""Number of nodes below which neighbouring nodes also enter the estimate of a region's rotation."""


@dataclass(frozen=True)
class Target:
    """Rigid displacement of a handle: a turn about its pivot, then a shift. World units, at the handle's time."""

    translation: Vector3 = (0.0, 0.0, 0.0)
    rotation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """wxyz, unit."""

    def __post_init__(self) -> None:
        """
        Raises:
            UserError: naming the field.
        """
        check_record(self, "target", _target_fields)

    @staticmethod
    def of(translation: Sequence[float] | None = None, rotation: Sequence[float] | None = None) -> Target:
        """Check and normalise a target.

        Raises:
            UserError: a number is not finite or too large, or the rotation has no direction.
        """
        target = Target(translation, rotation)  # type: ignore[arg-type]
        turned = target.rotation
        if not any(turned):
            raise UserError("target: rotation has no direction; give 4 numbers, not all 0")
        if abs(math.fsum(x * x for x in turned) - 1.0) > 1e-12:
            scale = max(map(abs, turned))
            target = Target(target.translation, tuple(unit(np.array(turned) / scale).tolist()))
        return target

    @property
    def is_identity(self) -> bool:
        return not any(self.translation) and not any(self.rotation[1:])


def _target_fields(node: FieldReader) -> dict[str, Any]:
    return {
        "translation": node.vector("translation", 3, (0.0, 0.0, 0.0)),
        "rotation": node.vector("rotation", 4, (1.0, 0.0, 0.0, 0.0), -math.inf, math.inf),
    }


STAY = Target()


@dataclass(frozen=True)
class Handle:
    """Set of control points that moves as one."""

    name: str
    nodes: tuple[int, ...]
    """Ascending, at least one."""
    time: float = 0.0
    """Scene time at which the handle was made, and to which its pivot and targets refer."""
    pivot: Vector3 | None = None
    """Centre of rotation, world units; None: the mean of the nodes."""
    stiffness: float | None = None
    """None: nodes go exactly to the target. A number: nodes are pulled there with this stiffness (edges have 1)."""
    turns: bool | None = None
    """True: the handle also fixes its nodes' rotations. False: it fixes their positions only. None: as True if a target
    or keyframe turns the handle; until then its nodes move as a free rigid body, whose rotation the solver finds."""
    lasts: Lasting = "motion"
    """motion: the edit shows throughout, carried along by the nodes; frame: it shows in one frame; fade: it fades out
    over ``window`` on either side of the handle's time."""
    window: float = 0.1
    """Distance in scene time from the handle's own time at which a fading handle's effect ends."""
    part: str | None = None
    """Part of the edit's skeleton that the handle poses, with all parts that hang on it; ``nodes`` are the part's. Its
    target turns it about its joint (or ``pivot``), relative to its parent and to the motion."""

    def __post_init__(self) -> None:
        """Check and convert the fields. Whether the nodes exist is checked when the edit is applied to a scene.

        Raises:
            UserError: naming the field.
        """
        check_record(
            self, f"handle {self.name!r}", lambda node: {"nodes": node.indices("nodes", 1), **handle_fields(node)}
        )

    def moves_freely(self, turned: bool) -> bool:
        """Return whether the nodes move as a free rigid body.

        Args:
            turned: whether any target or keyframe of the edit turns the handle.
        """
        return self.part is None and self.turns is None and not turned and len(self.nodes) > 1

    def gives_rotation(self, turned: bool) -> bool:
        """Return whether the handle fixes its nodes' rotations."""
        return turned if self.turns is None else self.turns

    def strength(self, time: float, frame: float = ONE_FRAME) -> float:
        """Return the share of the handle's target that applies at a scene time: 0 to 1, smooth for a fading handle."""
        away = abs(time - self.time)
        if self.lasts == "motion" or away == 0.0:
            return 1.0
        if self.lasts == "frame":
            return 1.0 if away <= frame else 0.0
        share = 1.0 - away / self.window if self.window > 0 else 0.0
        return 0.0 if share <= 0 else share * share * (3.0 - 2.0 * share)


def handle_fields(node: FieldReader, name: str | None = None) -> dict[str, Any]:
    """Read all fields of a handle but its nodes.

    Args:
        name: name of a handle that has none; None: it must have one.

    Raises:
        UserError: naming the field.
    """
    return {
        "name": node.text_or_none("name") or name or node.text("name"),
        "time": node.number("time", 0.0, 0.0, 1.0),
        "pivot": node.vector("pivot", 3),
        "stiffness": node.number("stiffness", None, MIN_STIFFNESS, MAX_STIFFNESS),
        "turns": node.boolean("turns"),
        "lasts": node.choice("lasts", get_args(Lasting), "motion"),
        "window": node.number("window", 0.1, 1e-6, 10.0),
        "part": node.text_or_none("part"),
    }


class Goal(NamedTuple):
    """Pose that a handle requests at one instant, normalised units. Its path from the base pose (share 0 to 1) is an
    arc about the pivot, not a straight line."""

    nodes: np.ndarray
    """[n]"""
    pivot: np.ndarray
    quat: np.ndarray
    translation: np.ndarray
    stiffness: float | None = None
    gives_rotation: bool = True
    residual: np.ndarray | None = None
    """[n, 3] displacement beyond the rigid motion."""
    own_turns: np.ndarray | None = None
    """[n, 4] rotations of the nodes beyond the rigid motion."""
    leaning: float | None = None
    """None: rotations are fixed. A number: they are pulled towards the goal, as a stiffness pulls positions."""
    free: bool = False
    """Whether the nodes move as a rigid body whose centre follows the goal and whose rotation is the solver's."""

    @property
    def is_identity(self) -> bool:
        return (
            not self.translation.any()
            and not self.quat[1:].any()
            and (self.residual is None or not self.residual.any())
        )

    def pose_at(self, rest: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [n, 3] and rotations [n, 3, 3] at ``share`` of the path."""
        quat = power(self.quat, share)
        positions = rest[self.nodes]
        if quat[1:].any():
            positions = rotate(quat, positions - self.pivot) + self.pivot
        positions = positions + share * self.translation
        if self.residual is not None:
            positions = positions + share * self.residual
        turns = np.broadcast_to(quat, (len(self.nodes), 4))
        if self.own_turns is not None:
            turns = multiply(turns, power(self.own_turns, share))
        return positions, to_matrix(turns)

    def sweep(self) -> tuple[float, float]:
        """Return the angle in radians and the distance that the goal covers, which decide the number of sub-steps."""
        distance = float(np.linalg.norm(self.translation))
        if self.residual is not None:
            distance += float(np.linalg.norm(self.residual, axis=1).max(initial=0.0))
        return float(angle(self.quat)), distance


def carried_goal(
    handle: Handle,
    target: Target,
    share: float,
    graph: ControlGraph,
    then: np.ndarray,
    now: np.ndarray,
    to_units: tuple[np.ndarray, float],
    turned: bool = True,
) -> Goal:
    """Carry a handle's target from its own time to another instant by the rigid motion of its nodes.

    Args:
        share: share of the target that applies, above 0. With a share below 1 the handle also holds its nodes less
            firmly.
        then, now: [M, 3] control points at the handle's time and at the requested instant, normalised units; the same
            object if the two are equal.
        to_units: (centre, scale) of the normalised scene.
        turned: whether any target or keyframe of the edit turns the handle.
    """
    centre, scale = to_units
    nodes = np.array(handle.nodes, np.int64)
    if handle.pivot is None:
        pivot = then[nodes].mean(0)
    else:
        pivot = (np.array(handle.pivot) - centre) * scale
    quat = power(np.array(target.rotation), share)
    translation = share * scale * np.array(target.translation)
    if now is not then:
        members = nodes
        if len(members) < MIN_NODES_FOR_FRAME:
            members = np.array(graph.ring(handle.nodes, 1))
        frame, before, after = rigid_fit(then[members], now[members])
        pivot = rotate(frame, pivot - before) + after
        quat = multiply(multiply(frame, quat), conjugate(frame)) if quat[1:].any() else quat
        translation = rotate(frame, translation)
    stiffness, leaning = handle.stiffness, None
    if share < 1.0:
        leaning = _clamp_stiffness(HALFWAY_STIFFNESS * share / (1.0 - share))
        stiffness = leaning if stiffness is None else _clamp_stiffness(stiffness * share)
    gives_rotation, free = handle.gives_rotation(turned), handle.moves_freely(turned)
    return Goal(nodes, pivot, quat, translation, stiffness, gives_rotation, leaning=leaning, free=free)


def _clamp_stiffness(stiffness: float) -> float:
    return min(max(stiffness, MIN_STIFFNESS), MAX_STIFFNESS)


def anchors_at(goals: Sequence[Goal], pins: np.ndarray, rest: np.ndarray, share: float) -> Anchors:
    """Return the constraints at ``share`` of the path. Later goals override earlier ones on the same node, and all of
    them override pins.

    Args:
        pins: nodes that keep their base positions and are not turned.
        rest: [M, 3] base positions.
    """
    count = len(rest)
    hard, turned, soft, leaning = np.zeros(count, bool), np.zeros(count, bool), np.zeros(count), np.zeros(count)
    positions, rotations = rest.copy(), np.tile(np.eye(3), (count, 1, 1))
    hard[pins] = turned[pins] = True
    label, arms, centers = np.full(count, -1, np.int64), np.zeros((count, 3)), []
    for goal in goals:
        at, turns = goal.pose_at(rest, share)
        label[goal.nodes] = len(centers) if goal.free else -1
        if goal.free:
            arms[goal.nodes] = rest[goal.nodes] - rest[goal.nodes].mean(0)
            centers.append(at.mean(0))
        positions[goal.nodes], rotations[goal.nodes] = at, turns
        hard[goal.nodes] = goal.stiffness is None
        soft[goal.nodes] = 0.0 if goal.stiffness is None else goal.stiffness
        told = goal.gives_rotation or goal.free
        turned[goal.nodes] = told and goal.leaning is None
        leaning[goal.nodes] = goal.leaning if told and goal.leaning is not None else 0.0
    groups = RigidGroups(label, arms, np.array(centers).reshape(-1, 3))
    return Anchors(hard, soft, turned, positions, rotations, leaning, groups)
