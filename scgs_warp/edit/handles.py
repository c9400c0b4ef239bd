"""What a user takes hold of: handles, where they were moved to, and what that asks of the solver. All frozen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from ..errors import UserError
from .field_reader import MAX_NUMBER, FieldReader
from .graph import ControlGraph
from .rotations import IDENTITY, angle, conjugate, multiply, power, rigid_fit, rotate, to_matrix, unit
from .solver import Anchors

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Lasting = Literal["motion", "frame", "fade"]

ONE_FRAME = 5e-3
"""What lasts one frame shows this far from its time, where nobody says how far frames are apart."""
HALFWAY_STIFFNESS = 10.0
"""Stiffness of a fading handle half way: it lets go of its nodes as its strength goes to 0, so that nothing jumps."""
MIN_STIFFNESS, MAX_STIFFNESS = 1e-6, 1e6
"""Limits of a stiffness."""
MIN_NODES_FOR_FRAME = 4
"""A region of fewer nodes takes its neighbours along to tell how it turns."""


@dataclass(frozen=True)
class Target:
    """Where a handle was moved to: turned about its pivot, then shifted. World units, at the handle's time."""

    translation: Vector3 = (0.0, 0.0, 0.0)
    rotation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """wxyz, unit."""

    @staticmethod
    def of(translation: Sequence[float] | None = None, rotation: Sequence[float] | None = None) -> Target:
        """Checked and normalised.

        Raises:
            UserError: a number is not finite or too large, or the rotation has no direction.
        """
        moved = tuple(float(x) for x in (translation if translation is not None else (0.0, 0.0, 0.0)))
        turned = tuple(float(x) for x in (rotation if rotation is not None else IDENTITY))
        if len(moved) != 3 or not all(math.isfinite(x) and abs(x) <= MAX_NUMBER for x in moved):
            limits = f"must be three finite numbers from {-MAX_NUMBER:g} to {MAX_NUMBER:g}"
            raise UserError(f"translation {list(moved)}: {limits}; the handle stays where it is")
        if len(turned) != 4 or not all(map(math.isfinite, turned)) or not any(turned):
            raise UserError(f"rotation {list(turned)}: must be four finite numbers, not all 0; the handle stays")
        if abs(math.fsum(x * x for x in turned) - 1.0) > 1e-12:
            scale = max(map(abs, turned))
            turned = tuple(unit(np.array(turned) / scale).tolist())
        return Target(moved, turned)  # type: ignore[arg-type]

    @property
    def is_identity(self) -> bool:
        return not any(self.translation) and not any(self.rotation[1:])


STAY = Target()


@dataclass(frozen=True)
class Handle:
    """A set of control points that is moved as one."""

    name: str
    nodes: tuple[int, ...]
    """Ascending, at least one."""
    time: float = 0.0
    """Scene time at which it was made; pivot and targets are said there."""
    pivot: Vector3 | None = None
    """World, what it turns about; None: the mean of its nodes."""
    stiffness: float | None = None
    """None: exactly where it is put. A number: pulled there, the weaker the smaller (1: as its edges)."""
    turns: bool | None = None
    """Whether its nodes' rotations are given, too. None: if it is more than one node."""
    lasts: Lasting = "motion"
    """The whole motion, in the nodes' own frames; one frame; or fading out over ``window`` around its time."""
    window: float = 0.1
    """Scene time after which a fading handle has no effect."""

    def __post_init__(self) -> None:
        """Check and convert all fields but the nodes, of which only a scene knows how many there are.

        Raises:
            UserError: naming the field.
        """
        for name, value in handle_fields(FieldReader(vars(self), f"handle {self.name!r}")).items():
            object.__setattr__(self, name, value)

    @property
    def gives_rotation(self) -> bool:
        return len(self.nodes) > 1 if self.turns is None else self.turns

    def strength(self, time: float, frame: float = ONE_FRAME) -> float:
        """How much of its target counts at a scene time: 0 to 1, smooth for a fading one."""
        away = abs(time - self.time)
        if self.lasts == "motion" or away == 0.0:
            return 1.0
        if self.lasts == "frame":
            return 1.0 if away <= frame else 0.0
        share = 1.0 - away / self.window if self.window > 0 else 0.0
        return 0.0 if share <= 0 else share * share * (3.0 - 2.0 * share)


def handle_fields(node: FieldReader) -> dict[str, Any]:
    """Read a handle's fields, all but its nodes.

    Raises:
        UserError: naming the field.
    """
    return {
        "name": node.text("name"),
        "time": node.number("time", 0.0, 0.0, 1.0),
        "pivot": node.vector("pivot", 3),
        "stiffness": node.number("stiffness", None, MIN_STIFFNESS, MAX_STIFFNESS),
        "turns": node.boolean("turns"),
        "lasts": node.choice("lasts", get_args(Lasting), "motion"),
        "window": node.number("window", 0.1, 1e-6, 10.0),
    }


class Goal(NamedTuple):
    """What a handle asks for at one instant, normalised units. On the way there (share 0 to 1) it turns about its
    pivot; it does not cut across."""

    nodes: np.ndarray
    """[n]"""
    pivot: np.ndarray
    quat: np.ndarray
    translation: np.ndarray
    stiffness: float | None = None
    gives_rotation: bool = True
    residual: np.ndarray | None = None
    """[n, 3] what the rigid motion does not explain."""
    own_turns: np.ndarray | None = None
    """[n, 4] rotations of single nodes beyond the rigid motion."""
    leaning: float | None = None
    """None: rotations are as given. A number: they are drawn there, as positions by a stiffness."""

    @property
    def is_identity(self) -> bool:
        return (
            not self.translation.any()
            and not self.quat[1:].any()
            and (self.residual is None or not self.residual.any())
        )

    def pose_at(self, rest: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions [n, 3] and rotations [n, 3, 3] at ``share`` of the way."""
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

    def sweep(self, rest: np.ndarray) -> tuple[float, float]:
        """(angle in radians, distance) it has to go, for the number of sub-steps."""
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
) -> Goal:
    """A handle's target, said at the handle's time, at another instant: carried by the rigid motion of its nodes.

    Args:
        share: how much of the target counts, above 0; below 1 its nodes are held less firmly, too.
        then, now: [M, 3] control points at the handle's time and at the instant asked for, normalised units; the same
            object where they are the same.
        to_units: (centre, scale) of the normalised scene.
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
    return Goal(nodes, pivot, quat, translation, stiffness, handle.gives_rotation, leaning=leaning)


def _clamp_stiffness(stiffness: float) -> float:
    return min(max(stiffness, MIN_STIFFNESS), MAX_STIFFNESS)


def anchors_at(goals: Sequence[Goal], pins: np.ndarray, rest: np.ndarray, share: float) -> Anchors:
    """What is held at ``share`` of the way. Of two goals for one node the later counts; goals count more than pins.

    Args:
        pins: nodes that stay, turned by nothing.
        rest: [M, 3]
    """
    count = len(rest)
    hard, turned, soft, leaning = np.zeros(count, bool), np.zeros(count, bool), np.zeros(count), np.zeros(count)
    positions, rotations = rest.copy(), np.tile(np.eye(3), (count, 1, 1))
    hard[pins] = turned[pins] = True
    for goal in goals:
        at, turns = goal.pose_at(rest, share)
        positions[goal.nodes], rotations[goal.nodes] = at, turns
        hard[goal.nodes] = goal.stiffness is None
        soft[goal.nodes] = 0.0 if goal.stiffness is None else goal.stiffness
        turned[goal.nodes] = goal.gives_rotation and goal.leaning is None
        leaning[goal.nodes] = goal.leaning if goal.gives_rotation and goal.leaning is not None else 0.0
    return Anchors(hard, soft, turned, positions, rotations, leaning)
