"""Changes to a scene's own motion: its speed and direction, regions held still, exaggeration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from .field_reader import FieldReader, check_record
from .keyframes import MAX_SECONDS

Repeat = Literal["once", "loop", "swing"]
Frame = Literal["body", "world"]


@dataclass(frozen=True)
class Playback:
    """Map from film time to scene time."""

    seconds: float | None = None
    """Duration of the whole motion at speed 1; None: that of the film."""
    speed: float = 1.0
    """Speed relative to ``seconds``; negative: backwards."""
    start: float = 0.0
    """Scene time at which the film begins (``1 - start`` if it plays backwards)."""
    repeat: Repeat = "once"
    """once: stop at the end; loop: jump back to the beginning; swing: play back and forth."""
    freeze: float | None = None
    """Scene time to show throughout the film."""
    map: tuple[tuple[float, float], ...] = ()
    """Pairs (second of the film, scene time), interpolated linearly; they replace the fields above."""

    def __post_init__(self) -> None:
        """
        Raises:
            UserError: naming the field.
        """
        check_record(self, "playback", playback_fields)

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


def playback_fields(node: FieldReader) -> dict[str, Any]:
    """Read all fields of a playback.

    Raises:
        UserError: naming the field.
    """
    return {
        "seconds": node.number("seconds", None, 1e-3, MAX_SECONDS),
        "speed": node.number("speed", 1.0, -1000.0, 1000.0),
        "start": node.number("start", 0.0, 0.0, 1.0),
        "repeat": node.choice("repeat", get_args(Repeat), "once"),
        "freeze": node.number("freeze", None, 0.0, 1.0),
        "map": _map(node),
    }


def _map(node: FieldReader) -> tuple[tuple[float, float], ...]:
    pairs: list[tuple[float, float]] = []
    for index, pair in enumerate(node.items("map")):
        name = f"map[{index}]"
        at, time = FieldReader({name: pair}, node.source, node.path).vector(name, 2) or (0.0, -1.0)
        if not (0.0 <= time <= 1.0 and at >= 0.0 and (not pairs or at > pairs[-1][0])):
            raise node.wrong(name, f"is [{at:g}, {time:g}]", "give rising seconds and scene times in [0, 1]")
        pairs.append((at, time))
    return tuple(pairs)


@dataclass(frozen=True)
class Hold:
    """Region that keeps the pose it has at one moment while the rest moves."""

    nodes: tuple[int, ...]
    time: float = 0.0
    """Scene time of the pose that the region keeps."""
    frame: Frame = "body"
    """body: the region still follows the surrounding body; world: it stays in place."""
    rings: int = 2
    """Number of rings of neighbours around the region that bend to join it to the rest."""

    def __post_init__(self) -> None:
        """
        Raises:
            UserError: naming the field.
        """
        check_record(self, "hold", lambda node: {"nodes": node.indices("nodes"), **hold_fields(node)})


def hold_fields(node: FieldReader) -> dict[str, Any]:
    """Read all fields of a hold but its nodes.

    Raises:
        UserError: naming the field.
    """
    return {
        "time": node.number("time", 0.0, 0.0, 1.0),
        "frame": node.choice("frame", get_args(Frame), "body"),
        "rings": node.integer("rings", 2, 0, 100),
    }


@dataclass(frozen=True)
class Exaggerate:
    """Exaggeration or damping of the motion: all turns are scaled."""

    factor: float = 1.5
    """1 leaves the motion unchanged, 0 gives the pose that ``about`` names."""
    about: float | None = None
    """Scene time of the pose that stays unchanged; None: the mean over time."""
    nodes: tuple[int, ...] = ()
    """Control points to which the factor applies; empty: all."""

    def __post_init__(self) -> None:
        """
        Raises:
            UserError: naming the field.
        """
        check_record(self, "exaggerate", lambda node: {"nodes": node.indices("nodes"), **exaggerate_fields(node)})


def exaggerate_fields(node: FieldReader) -> dict[str, Any]:
    """Read all fields of an exaggeration but its nodes.

    Raises:
        UserError: naming the field.
    """
    return {"factor": node.number("factor", 1.5, -10.0, 10.0), "about": node.number("about", None, 0.0, 1.0)}
