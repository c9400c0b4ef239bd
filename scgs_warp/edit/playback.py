"""A scene's own motion, played differently: slower, backwards, in a loop, with a limb held still, or exaggerated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np


@dataclass(frozen=True)
class Playback:
    """Which moment of the motion a moment of the film shows."""

    seconds: float | None = None
    """How long the whole motion takes at speed 1; None: as long as the film."""
    speed: float = 1.0
    """Negative: backwards."""
    start: float = 0.0
    """Scene time with which the film begins (backwards it begins with ``1 - start``)."""
    repeat: Literal["once", "loop", "swing"] = "once"
    """once: stops at the end; loop: jumps back to the beginning; swing: goes back the way it came."""
    freeze: float | None = None
    """This scene time throughout."""
    map: tuple[tuple[float, float], ...] = ()
    """(second of the film, scene time) pairs instead, straight in between."""

    def time_at(self, at: float, film_seconds: float) -> float:
        """Scene time in [0, 1] at a moment of the film."""
        return float(self.times_at(np.array([at]), film_seconds)[0])

    def times_at(self, at: np.ndarray, film_seconds: float) -> np.ndarray:
        """As ``time_at``, of many moments [F] at once."""
        if self.freeze is not None:
            return np.full(len(at), self.freeze)
        if self.map:
            return np.interp(at, [a for a, _ in self.map], [t for _, t in self.map])
        seconds = self.seconds if self.seconds is not None else film_seconds
        phase = self.start + abs(self.speed) * at / seconds if seconds > 0 else np.full(len(at), self.start)
        if self.repeat == "loop":
            phase = phase % 1.0
        elif self.repeat == "swing":
            phase = 1.0 - np.abs(phase % 2.0 - 1.0)
        phase = phase.clip(0.0, 1.0)
        return 1.0 - phase if self.speed < 0 else phase


@dataclass(frozen=True)
class Hold:
    """A region that keeps its pose of one moment while the rest moves."""

    nodes: tuple[int, ...]
    time: float = 0.0
    """Scene time whose pose it keeps."""
    frame: Literal["body", "world"] = "body"
    """body: it still goes along with what it hangs on; world: it stays in place."""
    rings: int = 2
    """So many rings of neighbours bend to make up for it."""


@dataclass(frozen=True)
class Exaggerate:
    """A motion with more (or less) of everything that it does."""

    factor: float = 1.5
    """1 changes nothing, 0 is the mean pose."""
    about: float | None = None
    """Scene time of the pose that stays as it is; None: the mean over time."""
    nodes: tuple[int, ...] = ()
    """Only these; none named: all."""
