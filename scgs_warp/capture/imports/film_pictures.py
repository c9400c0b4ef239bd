"""Pictures of a film whose cameras another program lists by the numbers of its frames."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...errors import UserError
from ..source import Video
from ..source_frame import SourceFrame

MOST_FRAMES = 600
"""Largest number of frames that are taken, evenly spaced."""
LARGEST = 1 << 16
"""Longer side of a picture up to which it is not reduced."""


class FilmPictures:
    """Pictures of a film by their number; asked for in ascending order, the film is decoded once."""

    def __init__(self, film: Video, wanted: list[int]) -> None:
        self._film, self._wanted = film, frozenset(wanted)
        self._frames: Iterator[SourceFrame] | None = None
        self._last: SourceFrame | None = None

    def at(self, number: int) -> np.ndarray:
        """Return a picture [H, W, 3] uint8 RGB.

        Raises:
            UserError: the film ends before it.
        """
        if self._frames is None or self._last is None or number < self._last.index:
            self._frames, self._last = self._film.frames(LARGEST, self._wanted), None
        while self._last is None or self._last.index < number:
            self._last = next(self._frames, None)
            if self._last is None:
                raise UserError(f"{self._film.path}: ends before frame {number}; export the recording again")
        return self._last.image
