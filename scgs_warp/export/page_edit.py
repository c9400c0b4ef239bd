"""An edit's film as the motion of a page: control points under the edit, at the moments of its film, and its camera."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from ..edit import EditSession
from ..edit.filming import film_view
from ..edit.pose import compose, own_pose
from ..errors import UserError
from ..geometry.cameras import STEEPEST
from ..motion.control_points import ControlPoints
from ..types import Pose
from .page_scene import PageMotion, even_times, one_sided, poses_at, sample_poses, to_array

LEAST_STEPS, MAX_SAMPLES = 120, 601
"""Least number of steps between moments: a page is smooth however few frames the film has. Largest number of moments: a
longer film has fewer samples than frames; the page interpolates between them."""
JUMP = 0.25
"""Difference in scene time between two moments from which on the film jumps, where nothing is interpolated."""


@torch.no_grad()
def edited_motion(
    session: EditSession,
    advance: Callable[[], None] | None = None,
    compute: Callable[[Callable[[], Any]], Any] = lambda pose: pose(),
) -> PageMotion:
    """Sample the control points of a session under its edit.

    Args:
        advance: called after each of the ``film_times(session)``.
        compute: calls the function that computes a pose and returns its result, so that another thread may compute.

    Raises:
        UserError: the motion is not finite.
    """
    engine, edit = session.engine, session.edit
    moments = film_times(session)
    times = [session.scene_time(at) for at in moments]
    tracks: dict[str, list[np.ndarray]] = {}
    for at, time in zip(moments, times):
        for name, values in compute(functools.partial(edited_pose, session, time, at)).items():
            tracks.setdefault(name, []).append(values)
        if advance is not None:
            advance()
    poses = {name: np.stack(values) for name, values in tracks.items()}
    if not all(np.isfinite(values).all() for values in poses.values()):
        raise UserError("--edit: the control points' motion is not finite; train again with a lower rate")
    steps = np.abs(np.diff(times))
    turned_back = edit.playback.repeat == "swing" or bool(edit.playback.map)
    facts: dict[str, Any] = {
        "seconds": edit.film.seconds,
        "jumps": [] if turned_back else np.flatnonzero(steps > JUMP).tolist(),
        "path": camera_path(session, moments),
        "overview": film_view(session, 0.0)[0].to_dict(),
    }
    if edit.film.background is not None:
        facts["background"] = list(edit.film.background)
    return PageMotion(to_array(engine.rig.positions), engine.binding, one_sided(poses), facts)


@torch.no_grad()
def own_motion(session: EditSession) -> PageMotion:
    """Return the scene's own motion as control points of a session, also of a static scene."""
    engine, motion = session.engine, session.scene.motion
    rest, times = to_array(engine.rig.positions), even_times(2)
    poses = sample_poses(motion) if isinstance(motion, ControlPoints) else poses_at(engine.rig, times)
    return PageMotion(rest, engine.binding, poses)


def film_times(session: EditSession) -> list[float]:
    """Return evenly spaced moments of the film in seconds, among them its frames if these are not too many, from its
    beginning to just before its end, where a film that is played again jumps to the beginning."""
    film = session.edit.film
    count = min(MAX_SAMPLES, film.frames * math.ceil(LEAST_STEPS / film.frames) + 1)
    return np.linspace(0.0, film.seconds * (1.0 - 1e-9), count).tolist()


def edited_pose(session: EditSession, time: float, at: float | None, *, live: bool = False) -> dict[str, np.ndarray]:
    """Return the poses of all control points at one instant, normalised units: ``translation`` [M, 3], ``rotation``,
    ``own`` and ``turn`` [M, 4], and ``shape``, ``log_scale`` or ``tint`` if the motion has them.

    With a motion mask, these are poses under holds and exaggeration alone, which a Gaussian follows by its share, and
    what handles do from there on follows: ``shift`` [M, 3] and ``further`` [M, 4].
    """
    engine = session.engine
    motion = engine.motion_at(time)
    if live and at is None:
        bent = engine.bend_live(session.edit, time, frame=session.edit.reach)
    else:
        bent = engine.bend(session.edit, time, at, frame=session.edit.reach)
    base = bent.base if bent is not None and engine.masked and bent.base is not None else bent
    pose: Pose = motion.pose if base is None else compose(motion, base)
    own = None if base is None else own_pose(motion, base)
    still = np.zeros((len(motion.positions), 4))
    still[:, 0] = 1.0
    found = {
        "translation": to_array(pose.translations),
        "rotation": to_array(pose.rotations),
        "own": to_array((pose if own is None else own).turns_of_shapes),
        "turn": still if base is None else base.color_turns,
    }
    if engine.masked:
        found["further"], found["shift"] = still, np.zeros((len(still), 3))
        if bent is not None and base is not None:
            found["further"], found["shift"] = bent.turns_since(base), bent.positions - base.positions
    others = {"shape": pose.shape_rotations, "log_scale": pose.log_scales, "tint": pose.tints}
    return {**found, **{name: to_array(value) for name, value in others.items() if value is not None}}


def camera_path(session: EditSession, moments: Sequence[float]) -> list[list[float]]:
    """Return azimuth, elevation (degrees), distance and target (world units) of the film's camera at each moment."""
    rows = []
    for at in moments:
        overview, azimuth, elevation = film_view(session, at)
        tilt = max(-STEEPEST, min(STEEPEST, elevation))
        rows.append([round(value, 6) for value in (azimuth, tilt, overview.radius, *overview.centre)])
    return rows
