"""An edit as a frozen value: all changes to a scene, and the film that shows them. Undo restores an earlier value."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal, get_args

import numpy as np

from ..errors import UserError
from .field_reader import FieldReader, check_record, show_value
from .handles import ONE_FRAME, Handle, Target, Vector3
from .keyframes import MAX_SECONDS, Keyframe
from .part_skin import SkinName
from .playback import Exaggerate, Hold, Playback
from .skeleton import Skeleton

ShotKind = Literal["turntable", "fixed", "orbit"]

MAX_FILM_SIZE = 8192
"""Longer side in pixels."""


@dataclass(frozen=True)
class View:
    """Film camera at one moment, on a sphere around its target. A field that is None takes its value from the training
    cameras."""

    at: float = 0.0
    """Time in the film, seconds."""
    azimuth: float | None = None
    """Degrees."""
    elevation: float | None = None
    distance: float | None = None
    """World units."""
    target: Vector3 | None = None
    """Point that the camera looks at, world units."""

    def __post_init__(self) -> None:
        """
        Raises:
            UserError: naming the field.
        """
        check_record(self, "view", view_fields)


def view_fields(node: FieldReader) -> dict[str, Any]:
    """Read all fields of a view.

    Raises:
        UserError: naming the field.
    """
    return {
        "at": node.number("at", 0.0, 0.0, MAX_SECONDS),
        "azimuth": node.number("azimuth", None, -1e5, 1e5),
        "elevation": node.number("elevation", None, -80.0, 80.0),
        "distance": node.number("distance", None, 1e-9),
        "target": node.vector("target", 3),
    }


@dataclass(frozen=True)
class Shot:
    """Path of the film's camera."""

    kind: ShotKind = "turntable"
    """turntable: ``turns`` around the scene from the first view; fixed: the first view throughout; orbit: smoothly
    through all views."""
    views: tuple[View, ...] = (View(),)
    turns: float = 1.0
    up: Vector3 | None = None
    fov: float | None = None
    """Horizontal, degrees."""

    def __post_init__(self) -> None:
        """Check and convert the fields, and put the views in order.

        Raises:
            UserError: naming the field.
        """
        read = lambda node: {"views": ordered_views(node, node.records("views", View)), **shot_fields(node)}  # noqa: E731
        check_record(self, "shot", read)


def shot_fields(node: FieldReader) -> dict[str, Any]:
    """Read all fields of a shot but its views.

    Raises:
        UserError: naming the field.
    """
    return {
        "kind": node.choice("kind", get_args(ShotKind), "turntable"),
        "turns": node.number("turns", 1.0, -1000.0, 1000.0),
        "up": node.direction("up"),
        "fov": node.number("fov", None, 1.0, 150.0),
    }


def ordered_views(node: FieldReader, views: Iterable[View]) -> tuple[View, ...]:
    """Return a shot's views in their order, one if there is none.

    Raises:
        UserError: two are at one moment.
    """
    ordered = sorted(views, key=lambda view: view.at)
    if any(a.at == b.at for a, b in pairwise(ordered)):
        raise node.wrong("views", "has two at one moment", "give every view a moment of its own")
    return tuple(ordered) or (View(),)


@dataclass(frozen=True)
class Film:
    """Length, size and camera of the film that shows an edit."""

    seconds: float = 4.0
    fps: float = 30.0
    size: int = 512
    """Longer side in pixels."""
    background: Vector3 | None = None
    shot: Shot = Shot()

    def __post_init__(self) -> None:
        """
        Raises:
            UserError: naming the field.
        """
        check_record(self, "film", lambda node: {"shot": node.record("shot", Shot) or Shot(), **film_fields(node)})

    @property
    def frames(self) -> int:
        return max(1, round(self.seconds * self.fps))


def film_fields(node: FieldReader) -> dict[str, Any]:
    """Read all fields of a film but its shot.

    Raises:
        UserError: naming the field.
    """
    return {
        "seconds": node.number("seconds", 4.0, 1e-3, MAX_SECONDS),
        "fps": node.number("fps", 30.0, 0.01, 1000.0),
        "size": node.integer("size", 512, 16, MAX_FILM_SIZE),
        "background": node.vector("background", 3, None, 0.0, 1.0),
    }


@functools.lru_cache(maxsize=16)
def frame_reach(film: Film, playback: Playback) -> float:
    """Return the largest distance from a handle's time, in scene time, at which a one-frame edit still shows.

    It is half the median step between two frames of the film, so that exactly one frame shows the edit.
    """
    times = playback.times_at(np.arange(film.frames) / film.fps, film.seconds)
    steps = np.abs(np.diff(times))
    moving = steps[steps > 0]
    return float(np.median(moving)) / 2 * (1 + 1e-9) if len(moving) else ONE_FRAME


@dataclass(frozen=True)
class Edit:
    """All changes to a scene, and the film that shows them."""

    handles: tuple[Handle, ...] = ()
    """In order of precedence: where two handles hold one node, the later one wins."""
    pins: tuple[int, ...] = ()
    """Indices of pinned control points, which follow the motion alone; ascending."""
    targets: Mapping[str, Target] = field(default_factory=dict)
    """Present targets by handle. A handle that no keyframe names stays there for the whole film."""
    keyframes: tuple[Keyframe, ...] = ()
    """Ascending in time, all at different moments."""
    playback: Playback = field(default_factory=Playback)
    holds: tuple[Hold, ...] = ()
    exaggerate: Exaggerate | None = None
    film: Film = Film()
    skeleton: Skeleton | None = None
    """Parts to which handles refer; None: no handle poses a part, and the run's skeleton is unchanged."""

    skin: SkinName = "parts"
    """How Gaussians follow posed parts. parts: they follow the part to which they belong and those that it meets at a
    joint, and widen where the surface stretches; dual: the same, and motions blend as dual quaternions; nodes: by their
    trained weights, as they follow handles of control points."""

    def __post_init__(self) -> None:
        """Check the kinds of the fields, whose records check themselves, and put the keyframes in order.

        Raises:
            UserError: naming the field.
        """
        check_record(self, "edit", _edit_fields)

    def check_nodes(self, count: int) -> None:
        """Check that the scene has the control points that the edit names.

        Args:
            count: number of the scene's control points.

        Raises:
            UserError: naming the field.
        """
        regions = {"pins": self.pins, **{f"handle {handle.name!r}": handle.nodes for handle in self.handles}}
        regions |= {f"hold[{row}]": hold.nodes for row, hold in enumerate(self.holds)}
        regions |= {"exaggerate": () if self.exaggerate is None else self.exaggerate.nodes}
        for name, nodes in regions.items():
            if nodes and nodes[-1] >= count:
                raise UserError(f"{name}: control point {nodes[-1]}: there are {count}, from 0 on; choose among them")

    @property
    def reach(self) -> float:
        """Largest distance from a handle's time, in scene time, at which a one-frame edit still shows."""
        return frame_reach(self.film, self.playback)

    @property
    def after_film(self) -> str | None:
        """Line on the keyframes and views of the camera that lie after the film's end; None if there are none."""
        shot, end = self.film.shot, self.film.seconds
        late = {"keyframes": [frame.at for frame in self.keyframes if frame.at > end]}
        late["views of the camera"] = [view.at for view in shot.views[1:] if view.at > end and shot.kind == "orbit"]
        found = [f"{name} up to {times[-1]:g} s" for name, times in late.items() if times]
        if not found:
            return None
        return f"the film ends at {end:g} s, before {' and '.join(found)}; make film.seconds larger, or move them"

    def turned(self, name: str) -> bool:
        """Return whether any target or keyframe turns the handle of that name."""
        places = [self.targets, *(frame.targets for frame in self.keyframes)]
        return any(name in targets and any(targets[name].rotation[1:]) for targets in places)

    def without(self, name: str) -> Edit:
        """Return the edit without the handle of that name, if there is one, its target, and its part in keyframes."""
        frames = []
        for frame in self.keyframes:
            rest = {n: t for n, t in frame.targets.items() if n != name}
            frames += [dataclasses.replace(frame, targets=rest)] if rest or not frame.targets else []
        targets = {n: t for n, t in self.targets.items() if n != name}
        handles = tuple(h for h in self.handles if h.name != name)
        return dataclasses.replace(self, handles=handles, targets=targets, keyframes=tuple(frames))

    def with_name(self, old: str, new: str) -> Edit:
        """Return the edit with another name for a handle, also in targets and keyframes."""

        def named(targets: Mapping[str, Target]) -> dict[str, Target]:
            return {new if name == old else name: target for name, target in targets.items()}

        handles = tuple(dataclasses.replace(h, name=new) if h.name == old else h for h in self.handles)
        frames = tuple(dataclasses.replace(frame, targets=named(frame.targets)) for frame in self.keyframes)
        return dataclasses.replace(self, handles=handles, targets=named(self.targets), keyframes=frames)

    def named_after(self, part: str, name: str) -> Edit:
        """Return the edit in which the handles of ``part`` that are called ``name`` or ``name (2)`` are called after
        the part."""
        edit = self
        for handle in sorted(self.handles, key=lambda handle: (len(handle.name), handle.name)):
            if handle.part == part != name and re.fullmatch(re.escape(name) + r"( \(\d+\))?", handle.name):
                edit = edit.with_name(handle.name, edit.free_name(part))
        return edit

    def free_name(self, part: str) -> str:
        """Return a name for another handle of a part: the part's own, or the first free one with a number."""
        taken = {handle.name for handle in self.handles}
        names = [part, *(f"{part} ({i})" for i in range(2, len(taken) + 3))]
        return next(name for name in names if name not in taken)

    def handle(self, name: str) -> Handle | None:
        return next((handle for handle in self.handles if handle.name == name), None)


def given_edit(edit: Any, count: int) -> Edit:
    """Return an edit that a caller gives for a scene of ``count`` control points.

    Raises:
        UserError: it is no edit, or names a control point that does not exist.
    """
    if not isinstance(edit, Edit):
        raise UserError(f"edit is {show_value(edit)}; give a scgs_warp.edit.Edit, as session.edit is one")
    edit.check_nodes(count)
    return edit


def _edit_fields(node: FieldReader) -> dict[str, Any]:
    frames = sorted(node.records("keyframes", Keyframe), key=lambda frame: frame.at)
    for first, second in pairwise(frames):
        if first.at == second.at:
            raise node.wrong("keyframes", f"has two at {first.at:g} s", "leave one of them out")
    return {
        "handles": node.records("handles", Handle),
        "pins": node.indices("pins"),
        "targets": node.named_records("targets", Target),
        "keyframes": tuple(frames),
        "playback": node.record("playback", Playback) or Playback(),
        "holds": node.records("holds", Hold),
        "exaggerate": node.record("exaggerate", Exaggerate),
        "film": node.record("film", Film) or Film(),
        "skeleton": node.record("skeleton", Skeleton),
        "skin": node.choice("skin", get_args(SkinName), "parts"),
    }
