"""Times of a film's frames, made to rise: some containers store them in another order, lack them, or begin anew."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from heapq import heappop, heappush
from typing import TypeVar

REORDERED = 16
"""Largest number of frames by which the order of decoding differs from that of display, in all codecs in use."""
ANEW = 1.0
"""Least time, seconds, by which times must fall, for two frames one after the other, to count as beginning anew: at a
cut, or where a counter overflows. A single one is a straggler, as damage leaves it."""

Frame = TypeVar("Frame")


def rising(frames: Iterable[tuple[Frame, float | None]], rate: float, delay: int) -> Iterator[tuple[Frame, float]]:
    """Yield frames in order, with times in seconds that are 0 for the first and never fall.

    Args:
        frames: frames in order of display, with their times in seconds, None where unknown.
        rate: frames per second, for unknown times.
        delay: number of later frames whose times may be earlier; as many frames are held back. The times are sorted.
    """
    first, last, shift, fallen = None, 0.0, 0.0, 0
    for frame, second in _sorted(frames, rate, delay):
        first = second if first is None else first
        now = second - first + shift
        fallen = fallen + 1 if now < last - ANEW else 0
        if fallen == 2:
            shift += last + 1.0 / rate - now
            now, fallen = last + 1.0 / rate, 0
        last = max(last, now)
        yield frame, last


def _sorted(frames: Iterable[tuple[Frame, float | None]], rate: float, delay: int) -> Iterator[tuple[Frame, float]]:
    """Yield frames in order, with the smallest times of those held back, and with times where there are none."""
    waiting: deque[Frame] = deque()
    times: list[float] = []
    known, since, strayed = 0.0, 0, False
    for frame, second in frames:
        if second is None:
            second = known + since / rate
        else:
            strayed = second < known - ANEW and not strayed
            if not strayed:  # unknown times do not follow a straggler
                known, since = second, 0
        since += 1
        waiting.append(frame)
        heappush(times, second)
        if len(waiting) > delay:
            yield waiting.popleft(), heappop(times)
    while waiting:
        yield waiting.popleft(), heappop(times)
