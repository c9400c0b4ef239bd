"""Schedule of the poses that pages wait for. The pose of a drag comes first; of it only the newest is computed."""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

MAX_WANTED = 256
"""Largest number of frames that one page may wait for; the oldest requests are dropped."""


class Wanted(NamedTuple):
    """Frame of the film for one page."""

    version: int
    frame: int


class PoseSchedule:
    """Schedule for a ``Worker``, whose lock guards it."""

    def __init__(self) -> None:
        self._live = False
        self._frames: dict[int, OrderedDict[Wanted, None]] = {}
        self._last = 0

    def ask_live(self) -> None:
        """Ask for the pose of the present moment, for all pages."""
        self._live = True

    def ask_frames(self, client: int, version: int, frames: list[int]) -> None:
        """Ask for frames for one page, in this order; earlier requests for other versions are dropped."""
        waiting = self._frames.setdefault(client, OrderedDict())
        for old in [wanted for wanted in waiting if wanted.version != version]:
            del waiting[old]
        for frame in frames:
            waiting[Wanted(version, frame)] = None
        while len(waiting) > MAX_WANTED:
            waiting.popitem(last=False)

    def drop(self, client: int) -> None:
        self._frames.pop(client, None)

    def next(self) -> tuple[int, Wanted | None] | None:
        """Return a page with the frame that it is to get, None for the live pose of all pages; clients take turns."""
        if self._live:
            self._live = False
            return 0, None
        waiting = [client for client, frames in self._frames.items() if frames]
        if not waiting:
            return None
        later = [client for client in waiting if client > self._last]
        self._last = min(later or waiting)
        return self._last, self._frames[self._last].popitem(last=False)[0]

    @property
    def settled(self) -> bool:
        """True if nothing is due."""
        return not self._live and not any(self._frames.values())
