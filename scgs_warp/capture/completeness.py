"""Films that end before their headers say: copies that were cut off, recordings that were never finished, damage."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

LOST_SHARE, LOST_FRAMES = 0.02, 8
"""Share and number of the frames that may be missing: encoders and trimming leave out a few."""
EVEN = 0.9
"""Least share of the times between frames that are about the usual one, for a film of an even rate."""
MOST_LOST = 4
"""Largest number of lost frames for each that is left; beyond it, the film rests most of the time."""
HARDLY_ANY = 0.05
"""Share of the frames below which a film is refused."""


class Header(NamedTuple):
    """What a film's header says about its pictures; zeros if it says nothing that can be trusted."""

    frames: int
    seconds: float
    counted: bool
    """True if ``frames`` is the number of stored pictures; False if it follows from ``seconds``, and pictures may be
    fewer where the film rests."""


class Incomplete(NamedTuple):
    """What is there of an incomplete film."""

    decoded: int
    announced: int
    """Number of frames according to the header."""
    seconds: float
    """Time of the last frame, from that of the first."""

    def describe(self) -> str:
        """Say what is there, and the remedy."""
        return (
            f"{self.decoded} of {self.announced} frames can be decoded, until second {self.seconds:.2f}; the file is "
            "incomplete or damaged: copy it again from where it was recorded"
        )

    @property
    def useless(self) -> bool:
        """True if hardly anything is there."""
        return self.decoded < HARDLY_ANY * self.announced


def header_of(container: Any, stream: Any) -> Header:
    """Read the header of a video stream of PyAV."""
    kind, rate = container.format.name, float(stream.average_rate or 0)
    if kind.startswith("mov,"):
        seconds = float((stream.duration or 0) * (stream.time_base or 0))
        return Header(stream.frames or round(seconds * rate), seconds, stream.frames > 0)
    if kind == "avi" and rate > 0:  # Frames at rest may be empty, and the duration is that of what is left.
        return Header(stream.frames, stream.frames / rate, False)
    if kind.startswith("matroska"):
        seconds = _stated(stream.metadata.get("DURATION", ""))
        if not seconds and len(container.streams) == 1:
            seconds = float(container.duration or 0) / 1e6
        return Header(round(seconds * rate), seconds, False)
    return Header(0, 0.0, False)


def _stated(text: str) -> float:
    """Parse hours, minutes and seconds; return 0 if the text is none."""
    parts = re.fullmatch(r"(\d{1,4}):(\d\d):(\d\d(?:\.\d{1,12})?)", text)
    return int(parts[1]) * 3600.0 + int(parts[2]) * 60.0 + float(parts[3]) if parts else 0.0


def lost_in_gaps(seconds: Sequence[float] | np.ndarray) -> int:
    """Return the number of frames that are missing where a film of an even rate has none for long, by the times of the
    others: damage of .mkv and .ts leaves such gaps. A film that rests for most of its time has lost none."""
    steps = np.diff(np.asarray(seconds, np.float64))
    usual = float(np.median(steps)) if len(steps) else 0.0
    if usual <= 0.0 or (steps < 1.5 * usual).mean() < EVEN:
        return 0
    lost = round(float((steps[steps > LOST_FRAMES * usual] / usual - 1.0).sum()))
    return lost if lost < MOST_LOST * len(seconds) else 0


def incomplete(
    header: Header, rate: float, *, decoded: int, hidden: int, seconds: float, latest: float, lost: int = 0
) -> Incomplete | None:
    """Compare what is there with the header; return None if nothing noteworthy is missing.

    Args:
        rate: frames per second.
        decoded: number of frames.
        hidden: number of stored pictures that an edit list cuts off.
        seconds: time of the last frame, from that of the first.
        latest: the same on the file's clock.
        lost: number of frames that are missing in gaps, which counts if the header does not count frames.
    """
    announced = header.frames - hidden if header.counted else header.frames
    until_end = round((header.seconds - max(seconds, latest)) * rate) - 1
    missing = announced - decoded if header.counted else until_end
    most = max(LOST_FRAMES, LOST_SHARE * announced)
    interlaced = until_end <= most and abs(announced - 2 * decoded) <= most  # Each half of a frame may be stored alone.
    if missing > most and not interlaced:
        return Incomplete(decoded, announced, seconds)
    return Incomplete(decoded, decoded + lost, seconds) if lost and not header.counted else None
