"""Retargeting: a motion of one body plays on the parts of another scene, as keyframes.

Parts are matched by name or by hand; what lies between two matched parts of the source is composed. A limb of the
target points where that of the source points, also where the two begin in different poses: between them lies the least
rotation that takes the one direction to the other. The trunk turns as far as that of the source since its first
instant.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import UserError
from .body_motion import UP, BodyMotion
from .document import Edit
from .field_reader import one_line, read_object, show_value
from .handles import Handle, Target
from .keyframes import Keyframe
from .playback import Playback
from .rotations import IDENTITY, conjugate, least_turn, multiply
from .skeleton import AUTOMATIC, Skeleton

if TYPE_CHECKING:
    from .session import EditSession


@dataclasses.dataclass(frozen=True)
class Stance:
    """Parts of the target at the frozen moment, world units."""

    time: float
    skeleton: Skeleton
    joints: np.ndarray
    """[P, 3] as in ``BodyMotion``, at that moment."""
    centres: np.ndarray
    """[P, 3]"""
    up: np.ndarray
    """[3] unit vector"""
    height: float
    """Extent along ``up``."""


def match_names(skeleton: Skeleton, motion: BodyMotion) -> dict[str, str]:
    """Return the parts of both bodies that have the same name but for case. Names that nobody gave (``part-3``) say
    nothing of another body's parts."""
    known = {name.casefold(): name for name in motion.names if not AUTOMATIC.fullmatch(name)}
    return {name: known[name.casefold()] for name in skeleton.names if name.casefold() in known}


def retargeted(edit: Edit, stance: Stance, motion: BodyMotion, match: Mapping[str, str], travel: bool = True) -> Edit:
    """Return the edit with the motion as keyframes, on the scene frozen at the stance's time; handles, holds and
    exaggeration of before are removed.

    Args:
        match: parts of the source by parts of the target.
        travel: whether the body moves through the scene as the source does, scaled by the heights.

    Raises:
        UserError: nothing is matched, or a name is unknown.
    """
    skeleton = stance.skeleton
    if not match:
        raise UserError(
            f"no part of the motion is matched: its parts are {', '.join(motion.names)}, those of the scene are "
            f"{', '.join(skeleton.names)}; say which belong together (--match; names that nobody "
            "gave, such as part-3, say nothing of another body)"
        )
    motion = motion.turned(least_turn(np.array(UP), stance.up))
    source = {skeleton.part(name).name: motion.row(other) for name, other in match.items()}
    rows = {name: row for row, name in enumerate(skeleton.names)}
    order = [name for part in skeleton.parts if part.parent is None for name in skeleton.branch(part.name)]
    aligned = {name: _alignment(stance, motion, source, name, rows) for name in source}
    handles = tuple(Handle(name, skeleton.part(name).nodes, stance.time, part=name) for name in order if name in source)
    tops = [name for name in order if name in source and skeleton.part(name).parent is None]
    scale, frames = stance.height / max(motion.height, 1e-12), []
    for index, second in enumerate(motion.seconds.tolist()):
        world: dict[str, np.ndarray] = {}
        targets = {}
        for name in order:
            parent = skeleton.part(name).parent
            above = IDENTITY if parent is None else world[parent]
            world[name] = above
            if name in source:
                world[name] = multiply(motion.turns[index, source[name]], aligned[name])
                shift = scale * motion.shifts[index, source[name]] if travel and name in tops else np.zeros(3)
                targets[name] = Target.of(shift.tolist(), multiply(conjugate(above), world[name]).tolist())
        frames.append(Keyframe(second, targets, "linear"))
    length = float(motion.seconds[-1])
    film = dataclasses.replace(edit.film, seconds=length)
    return dataclasses.replace(
        edit, handles=handles, pins=(), targets={}, keyframes=tuple(frames), holds=(), exaggerate=None, film=film,
        playback=Playback(freeze=stance.time), skeleton=skeleton,
    )  # fmt: skip


def _alignment(
    stance: Stance, motion: BodyMotion, source: Mapping[str, int], name: str, rows: dict[str, int]
) -> np.ndarray:
    """Return the rotation [4] that takes the direction of a part of the target to that of its source, at the beginning
    of both. The identity for parts that branch and for those without a parent: these are no limbs."""
    skeleton = stance.skeleton
    below = _next_matched(skeleton, name, source)
    if skeleton.part(name).parent is None or len(below) > 1:
        return IDENTITY.copy()
    own, other = rows[name], source[name]
    if below:
        here = stance.joints[rows[below[0]]] - stance.joints[own]
        there = motion.joints[source[below[0]]] - motion.joints[other]
    else:
        here, there = stance.centres[own] - stance.joints[own], motion.centres[other] - motion.joints[other]
    return least_turn(here, there)


def _next_matched(skeleton: Skeleton, name: str, source: Mapping[str, int]) -> list[str]:
    """Return the matched parts below a part, without those below another one."""
    found: list[str] = []
    for child in skeleton.children(name):
        found += [child] if child in source else _next_matched(skeleton, child, source)
    return found


def stance_of(session: EditSession, time: float) -> Stance:
    """Describe the parts of a scene at a moment of its motion, without handles."""
    skeleton, places = session.skeleton, session.engine.to_world(session.engine.motion_at(time).positions)
    plain = session.fork()
    plain.edit = Edit(skeleton=skeleton)
    joints = np.array([plain.joint_of(name, time) for name in skeleton.names])
    centres = np.array([places[list(part.nodes)].mean(0) for part in skeleton.parts])
    up = np.array(session.scene.overview.up)
    return Stance(time, skeleton, joints, centres, up, float(np.ptp(places @ up)))


def retarget(
    session: EditSession,
    motion: BodyMotion,
    match: Mapping[str, str] | None = None,
    time: float = 0.0,
    travel: bool = True,
) -> dict[str, str]:
    """Play a motion on a scene that stands still at a moment of its own, as keyframes of the session's edit. One step
    for undo.

    Args:
        match: parts of the motion by parts of the scene; None: those of the same name.
        time: scene time of the frozen pose.
        travel: whether the body moves through the scene as in the motion, scaled by the heights.

    Returns:
        The parts that were matched.

    Raises:
        UserError: nothing is matched, a name is unknown, or the time is out of range.
    """
    if not 0.0 <= time <= 1.0:
        raise UserError(f"time {time:g}: give 0 to 1")
    match = match_names(session.skeleton, motion) if match is None else dict(match)
    session.apply(retargeted(session.edit, stance_of(session, time), motion, match, travel))
    return match


def read_match(path: Path) -> dict[str, str]:
    """Read which part of a motion plays on which part of a scene: a JSON object of names.

    Raises:
        UserError: the file cannot be read, or a value is not a name.
    """
    remedy = 'write {"part of the scene": "part of the motion", ...}'
    content = read_object(path, remedy)
    for name, other in content.items():
        if not isinstance(other, str):
            raise UserError(f"{path}: {one_line(name)} is {show_value(other)}; {remedy}")
    return dict(content)
