"""Conversion between picture and edit: control points that a click selects, and the pose of a handle's gizmo.

These functions solve for control points; call them on the worker's thread.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..edit import EditSession, Handle, Target
from ..edit.handles import STAY, carried_goal
from ..edit.rotations import IDENTITY, conjugate, from_matrix, multiply, rigid_fit, rotate, unit
from .model import Moment, Region

NOISE = 1e-7
"""Half the angle, in radians, of the smallest turn that counts. While a handle is only shifted, the browser reports
smaller turns, which are rounding errors."""


@dataclass(frozen=True)
class GizmoFrame:
    """Frame of an unmoved handle at the moment shown, world units; targets place the gizmo relative to it."""

    pivot: np.ndarray
    """[3]"""
    rotation: np.ndarray
    """[4] wxyz rotation of the handle's surroundings since the handle's own time."""
    free_turn: np.ndarray | None = None
    """[4] wxyz rotation that the solver found for a handle that moves as a free body, in the frame of the handle's own
    time; None if targets give the rotation. The gizmo shows it, so that an arc turns the handle on from there."""

    def pose(self, target: Target) -> tuple[np.ndarray, np.ndarray]:
        """Return position [3] and wxyz [4] of the gizmo for a target."""
        own = np.array(target.rotation) if self.free_turn is None else self.free_turn
        turned = multiply(multiply(self.rotation, own), conjugate(self.rotation))
        return self.pivot + rotate(self.rotation, np.array(target.translation)), turned

    def target(self, position: np.ndarray, wxyz: np.ndarray) -> Target:
        """Return the target for a pose of the gizmo, the inverse of ``pose``.

        Raises:
            UserError: a number is not finite.
        """
        Target.of(position.tolist(), wxyz.tolist())  # errors quote the numbers that the browser sent
        shift = rotate(conjugate(self.rotation), np.asarray(position, np.float64) - self.pivot)
        turn = multiply(multiply(conjugate(self.rotation), np.asarray(wxyz, np.float64)), self.rotation)
        checked = Target.of(shift.tolist(), turn.tolist())
        start = IDENTITY if self.free_turn is None else self.free_turn
        since = multiply(np.array(checked.rotation), conjugate(start))
        if all(abs(part) < NOISE for part in since[1:]):
            return Target(checked.translation)
        return Target(checked.translation, tuple(unit(np.array(checked.rotation)).tolist()))


def frame_of_handle(session: EditSession, handle: Handle, moment: Moment) -> GizmoFrame:
    """Return the frame of a handle at the moment shown."""
    engine = session.engine
    then = engine.base_at(session.edit, handle.time).positions
    now = then if moment.time == handle.time else engine.base_at(session.edit, moment.time).positions
    where = [carried_goal(handle, STAY, 1.0, session.graph, then, now, engine.units)]
    axes = np.eye(3)
    where += [
        carried_goal(handle, Target.of(axis), 1.0, session.graph, then, now, engine.units) for axis in axes.tolist()
    ]
    frame = np.stack([goal.translation for goal in where[1:]], axis=1) / engine.units[1]
    rotation, free_turn = from_matrix(frame), None
    if handle.moves_freely(session.edit.turned(handle.name)):
        turn = session.rotation_of(handle.name, moment.time, moment.at, live=moment.live)
        free_turn = multiply(multiply(conjugate(rotation), turn), rotation)
    return GizmoFrame(engine.to_world(where[0].pivot), rotation, free_turn)


def frame_of_selection(session: EditSession, nodes: tuple[int, ...], moment: Moment) -> tuple[GizmoFrame, Target]:
    """Return the frame of a new handle on these nodes, and the target that leaves them where they are."""
    chosen = list(nodes)
    base = session.engine.to_world(session.engine.base_at(session.edit, moment.time).positions)[chosen]
    now = session.node_positions(moment.time, moment.at)[chosen]
    if np.allclose(base, now, rtol=0, atol=1e-9):
        return GizmoFrame(base.mean(0), IDENTITY, IDENTITY), STAY
    turn, before, after = rigid_fit(base, now)
    turn = IDENTITY if len(chosen) < 3 else turn
    return GizmoFrame(base.mean(0), IDENTITY, turn), Target.of((after - before).tolist())


def region_at(session: EditSession, point: np.ndarray, region: Region, moment: Moment) -> tuple[int, ...]:
    """Return the control points that a click at a surface point selects, at least one."""
    nearest = session.nearest(point.tolist(), moment.time, moment.at)
    if region.kind == "rings":
        return session.ring([nearest], region.rings)
    return tuple(sorted({nearest, *session.within(point.tolist(), region.radius, moment.time, moment.at)}))
