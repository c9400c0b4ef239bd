"""An edit as a value: everything that was done to a scene, and the film to be made of it. Frozen, so that undo is a
list of these and a saved edit is the same edit."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from .handles import ONE_FRAME, Handle, Target, Vector3
from .keyframes import Keyframe
from .playback import Exaggerate, Hold, Playback


@dataclass(frozen=True)
class View:
    """Where a camera stands at one moment, on the sphere around the scene; None: as the training cameras stood."""

    at: float = 0.0
    """Seconds of the film."""
    azimuth: float | None = None
    """Degrees."""
    elevation: float | None = None
    distance: float | None = None
    """World units."""
    target: Vector3 | None = None
    """World, what it looks at."""


@dataclass(frozen=True)
class Shot:
    """How a film is filmed."""

    kind: Literal["turntable", "fixed", "orbit"] = "turntable"
    """turntable: ``turns`` around the scene from the first view; fixed: the first view throughout; orbit: through all
    views, smoothly."""
    views: tuple[View, ...] = (View(),)
    turns: float = 1.0
    up: Vector3 | None = None
    fov: float | None = None
    """Horizontal, degrees."""


@dataclass(frozen=True)
class Film:
    """What an edit is shown as."""

    seconds: float = 4.0
    fps: float = 30.0
    size: int = 512
    """Longer side in pixels."""
    background: Vector3 | None = None
    shot: Shot = Shot()

    @property
    def frames(self) -> int:
        return max(1, round(self.seconds * self.fps))


@functools.lru_cache(maxsize=16)
def frame_reach(film: Film, playback: Playback) -> float:
    """How far from its time an edit of one frame shows, so that one frame of the film does: half of its step."""
    times = playback.times_at(np.arange(film.frames) / film.fps, film.seconds)
    steps = np.abs(np.diff(times))
    moving = steps[steps > 0]
    return float(np.median(moving)) / 2 * (1 + 1e-9) if len(moving) else ONE_FRAME


@dataclass(frozen=True)
class Edit:
    """The whole edit."""

    handles: tuple[Handle, ...] = ()
    """Their order counts: of two on one node, the later has it."""
    pins: tuple[int, ...] = ()
    """Control points that stay with the motion, ascending."""
    targets: Mapping[str, Target] = field(default_factory=dict)
    """Where handles are now; a handle that no keyframe names stays there for the whole film."""
    keyframes: tuple[Keyframe, ...] = ()
    """Ascending in time, no two at one moment."""
    playback: Playback = field(default_factory=Playback)
    holds: tuple[Hold, ...] = ()
    exaggerate: Exaggerate | None = None
    film: Film = Film()

    @property
    def reach(self) -> float:
        """Scene time around its own in which an edit of one frame shows."""
        return frame_reach(self.film, self.playback)

    def handle(self, name: str) -> Handle | None:
        return next((handle for handle in self.handles if handle.name == name), None)
