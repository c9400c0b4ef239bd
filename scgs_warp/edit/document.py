"""An edit as a frozen value: all changes to a scene, and the film that shows them. Undo restores an earlier value."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from .handles import ONE_FRAME, Handle, Target, Vector3
from .keyframes import Keyframe
from .part_skin import SkinName
from .playback import Exaggerate, Hold, Playback
from .skeleton import Skeleton


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


@dataclass(frozen=True)
class Shot:
    """Path of the film's camera."""

    kind: Literal["turntable", "fixed", "orbit"] = "turntable"
    """turntable: ``turns`` around the scene from the first view; fixed: the first view throughout; orbit: smoothly
    through all views."""
    views: tuple[View, ...] = (View(),)
    turns: float = 1.0
    up: Vector3 | None = None
    fov: float | None = None
    """Horizontal, degrees."""


@dataclass(frozen=True)
class Film:
    """Length, size and camera of the film that shows an edit."""

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

    @property
    def reach(self) -> float:
        """Largest distance from a handle's time, in scene time, at which a one-frame edit still shows."""
        return frame_reach(self.film, self.playback)

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

    def handle(self, name: str) -> Handle | None:
        return next((handle for handle in self.handles if handle.name == name), None)
