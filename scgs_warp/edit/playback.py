"""Changes to a scene's own motion: its speed and direction, regions held still, exaggeration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..errors import UserError
from .keyframes import MAX_SECONDS

LIMITS = {"seconds": (1e-3, MAX_SECONDS), "speed": (-1000.0, 1000.0), "start": (0.0, 1.0), "freeze": (0.0, 1.0)}
"""Smallest and largest value of each number of a playback."""


@dataclass(frozen=True)
class Playback:
    """Map from film time to scene time."""

    seconds: float | None = None
    """Duration of the whole motion at speed 1; None: that of the film."""
    speed: float = 1.0
    """Speed relative to ``seconds``; negative: backwards."""
    start: float = 0.0
    """Scene time at which the film begins (``1 - start`` if it plays backwards)."""
    repeat: Literal["once", "loop", "swing"] = "once"
    """once: stop at the end; loop: jump back to the beginning; swing: play back and forth."""
    freeze: float | None = None
    """Scene time to show throughout the film."""
    map: tuple[tuple[float, float], ...] = ()
    """Pairs (second of the film, scene time), interpolated linearly; they replace the fields above."""

    def __post_init__(self) -> None:
        """
        Raises:
            UserError: a number is outside its range.
        """
        for name, (least, most) in LIMITS.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise UserError(f"playback: {name} is {value:g}; give a number from {least:g} to {most:g}")

    def time_at(self, at: float, film_seconds: float) -> float:
        """Return the scene time in [0, 1] at a moment of the film."""
        return float(self.times_at(np.array([at]), film_seconds)[0])

    def times_at(self, at: np.ndarray, film_seconds: float) -> np.ndarray:
        """Return the scene times [F] in [0, 1] at moments [F] of the film."""
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
    """Region that keeps the pose it has at one moment while the rest moves."""

    nodes: tuple[int, ...]
    time: float = 0.0
    """Scene time of the pose that the region keeps."""
    frame: Literal["body", "world"] = "body"
    """body: the region still follows the surrounding body; world: it stays in place."""
    rings: int = 2
    """Number of rings of neighbours around the region that bend to join it to the rest."""


@dataclass(frozen=True)
class Exaggerate:
    """Exaggeration or damping of the motion: all turns are scaled."""

    factor: float = 1.5
    """1 leaves the motion unchanged, 0 gives the pose that ``about`` names."""
    about: float | None = None
    """Scene time of the pose that stays unchanged; None: the mean over time."""
    nodes: tuple[int, ...] = ()
    """Control points to which the factor applies; empty: all."""
