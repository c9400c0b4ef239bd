"""Posing of parts in a session: turns of joints, and pulls on parts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ..errors import UserError
from ..scene.arguments import clamped_time, given_scalar
from ..types import Gaussians
from .document import Edit
from .field_reader import FieldReader, point_of
from .handles import STAY, Handle, Target
from .part_pose import JointFrame, PartMove, Rigid
from .reach import Link, reach
from .rotations import conjugate, from_axis, multiply, rigid_fit, rotate
from .skeleton import Skeleton, strongest
from .skeleton_changes import SkeletonChanges
from .skeleton_from_motion import MIN_OPACITY


class Posing(SkeletonChanges):
    """Base of :class:`EditSession` that poses parts. Points and lengths are in world units, angles in degrees."""

    _before_drag: Edit | None
    preview: Callable[[Edit], None]
    release: Callable[[], None]
    gaussians_at: Callable[..., Gaussians]

    def part_at(self, point: Sequence[float], time: float, at: float | None = None) -> str:
        """Return the part to which the opaque Gaussian nearest to a point of the edited scene belongs.

        Args:
            point: [3], from ``pick`` for example.
            time, at: moment at which the surface passes the point, as in ``node_positions``.
        """
        means = self.gaussians_at(time, at).means.cpu().double().numpy()
        opaque = np.flatnonzero((self.engine.scene.gaussians.opacities() > MIN_OPACITY).cpu().numpy())
        if len(opaque):
            means = means[opaque]
        nearest = int(((means - point_of("point", point)) ** 2).sum(1).argmin())
        return self.skeleton.names[int(self.gaussian_parts()[opaque[nearest] if len(opaque) else nearest])]

    def gaussian_parts(self) -> np.ndarray:
        """Return the row of the part to which each Gaussian belongs, [N]: of its control points' parts, the one with
        the largest weight."""
        indices, weights = (part.cpu().numpy() for part in self.engine.binding)
        return strongest(self.skeleton.owners()[indices], weights)

    def pose_part(self, part: str, time: float = 0.0) -> Handle:
        """Return the handle that poses a part at a time; add one if there is none, or none that shows then.

        Args:
            time: scene time, to which the target of a new handle refers.

        Raises:
            UserError: there is no such part.
        """
        edit, handle = _with_handle(self.edit, self.skeleton, part, time)
        if edit is not self.edit:
            self.apply(edit)
        return handle

    def chain(self, part: str) -> tuple[str, ...]:
        """Return the parts that turn when this part is pulled, from it towards the root; all others hold still."""
        return self.skeleton.chain(part)

    def joint_of(self, part: str, time: float, at: float | None = None) -> np.ndarray:
        """Return where a part's joint is under the edit, [3]."""
        return self._motion_of(self.edit, part, clamped_time(time), at)[1]

    def turn(self, part: str, degrees: float, axis: Sequence[float] | None = None, time: float = 0.0) -> Target:
        """Turn a part, with all that hangs on it, about its joint, relative to its parent. Repeated turns add up.

        Args:
            degrees: from -180 to 180.
            axis: [3] world direction at ``time``; None: the axis about which the motion turned the part most.
            time: scene time at which the part is turned; at other times the turn follows the parent.

        Raises:
            UserError: there is no such part, the motion shows no axis and none is given, or a number is wrong.
        """
        skeleton = self.skeleton
        axis = skeleton.part(part).axis if axis is None else axis
        if axis is None:
            raise UserError(f"part {part!r}: the motion shows no axis; give one, such as (0, 0, 1)")
        direction, angle = point_of("axis", axis), given_scalar("degrees", degrees, "-180 to 180")
        if not np.linalg.norm(direction) > 1e-6:
            raise UserError(f"axis {list(axis)}: give 3 finite numbers, not all close to 0")
        if not -180.0 <= angle <= 180.0:
            raise UserError(f"degrees {angle:g}: give -180 to 180")
        edit, handle = _with_handle(self.edit, skeleton, part, time)
        old = edit.targets.get(handle.name, STAY)
        further = self._into_frame(skeleton, handle, from_axis(direction, angle), time)
        target = Target.of(old.translation, multiply(further, np.array(old.rotation)).tolist())
        self.apply(dataclasses.replace(edit, targets={**edit.targets, handle.name: target}))
        return target

    def pull(
        self,
        part: str,
        to: Sequence[float],
        time: float = 0.0,
        grip: Sequence[float] | None = None,
        *,
        live: bool = False,
        since: Edit | None = None,
    ) -> tuple[str, ...]:
        """Pull a part to a place: the parts of its chain turn about their joints, as little as will do, and the rest
        holds still. A part without a parent is moved as a whole, with all that hangs on it.

        Args:
            to: [3] where the grip goes. Out of reach, the chain points there.
            time: scene time.
            grip: [3] point of the part in its present pose that is pulled; None: the mean of its control points.
            live: whether the pull belongs to a drag, which ``release`` ends. It is then measured from the pose, and the
                grip from the part, before the drag.
            since: edit from which a pull of a drag is measured; None: the one before the drag.

        Returns:
            The parts that turned, from the pulled one towards the root.

        Raises:
            UserError: there is no such part, or a number is wrong.
        """
        place = point_of("to", to)
        before = since or self._before_drag or self.edit
        skeleton = before.skeleton or self._run_skeleton()
        names, edit, handles = skeleton.chain(part), before, []
        for name in names:
            edit, handle = _with_handle(edit, skeleton, name, time)
            handles.append(handle)
        motion, _ = self._motion_of(edit, part, time, None)
        now = self.engine.base_at(edit, time).positions
        centre, scale = self.engine.units
        if grip is None:
            held = now[list(skeleton.part(part).nodes)].mean(0)
        else:
            held = motion.undo((point_of("grip", grip) - centre) * scale)
        place = (place - centre) * scale
        if skeleton.part(part).parent is None:
            targets = {handles[0].name: self._shifted(edit, skeleton, handles[0], time, place - motion.apply(held))}
        else:
            targets = self._reached(edit, skeleton, handles, time, held, place)
        edit = dataclasses.replace(edit, targets={**edit.targets, **targets})
        self.preview(edit)
        if not live:
            self.release()
        return names

    def rotate(
        self,
        part: str,
        rotation: Sequence[float],
        time: float = 0.0,
        *,
        about: Sequence[float] | None = None,
        live: bool = False,
        since: Edit | None = None,
    ) -> Target:
        """Turn a part, and all that hangs on it, about its joint, as seen in its present pose. ``turn`` counts axes
        from the pose without edits instead.

        Args:
            rotation: [4] wxyz, world.
            about: [3] world point that stays where it is seen; None: the part's joint.
            time, live, since: as in ``pull``.

        Raises:
            UserError: there is no such part, or a number is wrong.
        """
        asked = np.array(Target.of(None, rotation).rotation)
        before = since or self._before_drag or self.edit
        edit, handle = _with_handle(before, before.skeleton or self._run_skeleton(), part, time)
        skeleton = edit.skeleton or self._run_skeleton()
        above = skeleton.part(part).parent
        lead = Rigid.none() if above is None else self._motion_of(edit, above, time, None)[0]
        if above is not None:
            asked = multiply(multiply(conjugate(lead.quat), asked), lead.quat)
        old = edit.targets.get(handle.name, STAY)
        shift = old.translation
        if about is not None:
            centre, scale = self.engine.units
            fixed = lead.undo((point_of("about", about) - centre) * scale)
            shift = self._shift_about(skeleton, handle, time, old, asked, fixed)
        further = self._into_frame(skeleton, handle, asked, time)
        target = Target.of(shift, multiply(further, np.array(old.rotation)).tolist())
        self.preview(dataclasses.replace(edit, targets={**edit.targets, handle.name: target}))
        if not live:
            self.release()
        return target

    def _reached(
        self, edit: Edit, skeleton: Skeleton, handles: list[Handle], time: float, grip: np.ndarray, place: np.ndarray
    ) -> dict[str, Target]:
        """Solve for the targets that take a point of the first handle's part to a place, normalised units."""
        poser, links, frames = self.engine.poser(skeleton), [], []
        now = self.engine.base_at(edit, time).positions
        for handle in reversed(handles):
            then = self.engine.base_at(edit, handle.time).positions if handle.time != time else now
            joint, frame = poser.joint_frame(handle, then, now)
            target = edit.targets.get(handle.name, STAY)
            quat = multiply(multiply(frame, np.array(target.rotation)), conjugate(frame))
            shift = rotate(frame, self.engine.units[1] * np.array(target.translation))
            part = skeleton.part(handle.part or "")
            axis = None
            if part.axis is not None:
                lead = list(skeleton.part(part.parent or part.name).nodes)
                axis = rotate(rigid_fit(poser.start[lead], now[lead])[0], np.array(part.axis))
            links.append(Link(joint, quat, shift, axis))
            frames.append(frame)
        above = skeleton.part(handles[-1].part or "").parent
        base = Rigid.none() if above is None else self._motion_of(edit, above, time, None)[0]
        found, targets = reach(links, base, grip, place), {}
        for handle, frame, quat in zip(reversed(handles), frames, found.turns):
            own = multiply(multiply(conjugate(frame), quat), frame)
            targets[handle.name] = Target.of(edit.targets.get(handle.name, STAY).translation, own.tolist())
        first = handles[-1].name
        shift = rotate(conjugate(frames[0]), found.shift) / self.engine.units[1]
        targets[first] = Target.of(shift.tolist(), targets[first].rotation)
        return targets

    def _shifted(self, edit: Edit, skeleton: Skeleton, handle: Handle, time: float, shift: np.ndarray) -> Target:
        """Return the target of a root's handle after a further shift, normalised units."""
        old = edit.targets.get(handle.name, STAY)
        frame = self._joint_frame(skeleton, handle, time).frame
        further = rotate(conjugate(frame), shift) / self.engine.units[1]
        return Target.of((np.array(old.translation) + further).tolist(), old.rotation)

    def _shift_about(
        self, skeleton: Skeleton, handle: Handle, time: float, old: Target, quat: np.ndarray, fixed: np.ndarray
    ) -> list[float]:
        """Return the translation with which a further turn leaves a point, [3] in the frame of the parent, in place."""
        joint, frame = self._joint_frame(skeleton, handle, time)
        scale = self.engine.units[1]
        place = joint + rotate(frame, scale * np.array(old.translation))
        moved = fixed + rotate(quat, place - fixed) - joint
        return (rotate(conjugate(frame), moved) / scale).tolist()

    def _joint_frame(self, skeleton: Skeleton, handle: Handle, time: float) -> JointFrame:
        """Return a part's joint at a time, and the rotation of its parent from the handle's time to then."""
        now = self.engine.base_at(self.edit, time).positions
        then = now if handle.time == time else self.engine.base_at(self.edit, handle.time).positions
        return self.engine.poser(skeleton).joint_frame(handle, then, now)

    def _into_frame(self, skeleton: Skeleton, handle: Handle, quat: np.ndarray, time: float) -> np.ndarray:
        frame = self._joint_frame(skeleton, handle, time).frame
        return quat if not frame[1:].any() else multiply(multiply(conjugate(frame), quat), frame)

    def _motion_of(self, edit: Edit, part: str, time: float, at: float | None) -> tuple[Rigid, np.ndarray]:
        """Return how the edit moves a part, normalised units, and the place of its joint, [3] world units."""
        skeleton = edit.skeleton or self._run_skeleton()
        skeleton.part(part)
        poser, now = self.engine.poser(skeleton), self.engine.base_at(edit, time).positions
        targets, moves = self.engine.targets(edit, at), []
        for handle in edit.handles:
            share = handle.strength(time, edit.reach) if handle.part is not None else 0.0
            if share > 0.0:
                then = now if handle.time == time else self.engine.base_at(edit, handle.time).positions
                moves.append(PartMove(handle, targets[handle.name], share, then))
        motion = poser.motions(moves, now)[0][poser.rows[part]]
        probe = Handle(part, skeleton.part(part).nodes, time, part=part)
        joint = poser.joint_frame(probe, now, now).joint
        return motion, self.engine.to_world(motion.apply(joint))


def _with_handle(edit: Edit, skeleton: Skeleton, part: str, time: float) -> tuple[Edit, Handle]:
    """Return the edit with a handle that poses a part at a time, and that handle; the same edit if it has one."""
    nodes = skeleton.part(part).nodes
    time = given_scalar(f"part {part!r}: time", time, "a number from 0 to 1")
    FieldReader({"time": time}, f"part {part!r}").number("time", None, 0.0, 1.0)
    own = [row for row, handle in enumerate(edit.handles) if handle.part == part]
    acting = [edit.handles[row] for row in own if edit.handles[row].strength(time, edit.reach) > 0.0]
    if acting:
        return edit, acting[-1]  # which counts
    handle = Handle(edit.free_name(part), nodes, time, part=part)
    row = own[0] if own else len(edit.handles)  # those of other moments count more
    handles = (*edit.handles[:row], handle, *edit.handles[row:])
    return dataclasses.replace(edit, handles=handles, skeleton=skeleton), handle
