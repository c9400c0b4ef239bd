"""Changes of keyframes as a timeline makes them: one handle's part of a keyframe, or a view of the film's camera, is
moved, copied or deleted. Every function returns another edit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

from ..edit import Edit, Keyframe, Target
from ..edit.document import View
from ..edit.keyframes import Easing
from ..errors import UserError

SAME = 1e-6
"""Difference in seconds below which two moments of a film are the same."""


def frame_at(edit: Edit, at: float) -> Keyframe | None:
    """Return the keyframe at a moment of the film."""
    return next((frame for frame in edit.keyframes if abs(frame.at - at) <= SAME), None)


def keyed(edit: Edit, at: float, targets: Mapping[str, Target], easing: Easing = "smooth") -> Edit:
    """Add targets to the keyframe at a moment, or add a keyframe."""
    old = frame_at(edit, at)
    frame = (
        Keyframe(at, dict(targets), easing)
        if old is None
        else dataclasses.replace(old, targets={**old.targets, **targets})
    )
    return _with_frames(edit, [*(other for other in edit.keyframes if other is not old), frame])


def moved(edit: Edit, name: str | None, begin: float, end: float, *, copy: bool = False) -> Edit:
    """Move a handle's key, or with None a whole keyframe, to another moment; a key that is there is replaced.

    Raises:
        UserError: there is no such key, or the moment lies outside the film.
    """
    old = _frame(edit, begin)
    if not 0.0 <= end <= edit.film.seconds:
        raise UserError(f"second {end:g}: a keyframe lies within the film of {edit.film.seconds:g} s")
    targets = old.targets if name is None else {name: _target(old, name)}
    if abs(begin - end) <= SAME:
        return edit
    if not copy:
        edit = removed(edit, name, begin)
    return keyed(edit, end, targets, old.easing)


def removed(edit: Edit, name: str | None, at: float) -> Edit:
    """Remove a handle's key, or with None a whole keyframe.

    Raises:
        UserError: there is no such key.
    """
    old = _frame(edit, at)
    rest = {} if name is None else {other: target for other, target in old.targets.items() if other != name}
    if name is not None:
        _target(old, name)
    return _changed(edit, old, lambda frame: dataclasses.replace(frame, targets=rest) if rest else None)


def eased(edit: Edit, at: float, easing: Easing) -> Edit:
    """Set the way from a keyframe to the next.

    Raises:
        UserError: there is no such keyframe.
    """
    return _changed(edit, _frame(edit, at), lambda frame: dataclasses.replace(frame, easing=easing))


def view_moved(edit: Edit, begin: float, end: float, *, copy: bool = False) -> Edit:
    """Move a view of the film's camera to another moment; a view that is there is replaced.

    Raises:
        UserError: there is no such view, or the moment lies outside the film.
    """
    old = _view(edit, begin)
    if not 0.0 <= end <= edit.film.seconds:
        raise UserError(f"second {end:g}: a view lies within the film of {edit.film.seconds:g} s")
    kept = [view for view in edit.film.shot.views if (copy or view is not old) and abs(view.at - end) > SAME]
    return _with_views(edit, [*kept, dataclasses.replace(old, at=end)])


def view_removed(edit: Edit, at: float) -> Edit:
    """Remove a view of the film's camera.

    Raises:
        UserError: there is no such view, or no other.
    """
    old = _view(edit, at)
    kept = [view for view in edit.film.shot.views if view is not old]
    if not kept:
        raise UserError("the path of the camera needs a view; let the film go round instead")
    return _with_views(edit, kept)


def _view(edit: Edit, at: float) -> View:
    shot = edit.film.shot
    view = next((view for view in shot.views if abs(view.at - at) <= SAME), None) if shot.kind == "orbit" else None
    if view is None:
        raise UserError(f"the camera has no view at second {at:g}; choose one on the timeline")
    return view


def _with_views(edit: Edit, views: list[View]) -> Edit:
    shot = dataclasses.replace(edit.film.shot, views=tuple(sorted(views, key=lambda view: view.at)))
    return dataclasses.replace(edit, film=dataclasses.replace(edit.film, shot=shot))


def _frame(edit: Edit, at: float) -> Keyframe:
    frame = frame_at(edit, at)
    if frame is None:
        raise UserError(f"there is no keyframe at second {at:g}; choose one on the timeline")
    return frame


def _target(frame: Keyframe, name: str) -> Target:
    if name not in frame.targets:
        raise UserError(f"{name!r} has no key at second {frame.at:g}; choose one on the timeline")
    return frame.targets[name]


def _changed(edit: Edit, old: Keyframe, change: Callable[[Keyframe], Keyframe | None]) -> Edit:
    frames = [change(frame) if frame is old else frame for frame in edit.keyframes]
    return _with_frames(edit, [frame for frame in frames if frame is not None])


def _with_frames(edit: Edit, frames: list[Keyframe]) -> Edit:
    return dataclasses.replace(edit, keyframes=tuple(sorted(frames, key=lambda frame: frame.at)))
