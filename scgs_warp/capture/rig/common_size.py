"""One size for the pictures of all cameras of a rig: a data set has only one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ...data.dataset import spread
from ...runtime.progress import ShowProgress
from ...storage.json_files import as_number
from ..bars import Bars, are_possible, common_bars
from ..source import Video

LEAST_SIDE = 480
"""Longer side to which pictures are reduced at most, for that of a smaller one: cameras are found with them. Beyond it,
they are cut."""
FAR_LARGER = 1.4
"""Ratio of the longer sides of two cameras' pictures above which the smaller one is worth a note."""
MOST_MOMENTS = 48
"""Number of pictures of a video in which black bars are looked for."""


class CommonSize(NamedTuple):
    """How the pictures of C cameras come to have about one size."""

    longest: int
    """Largest size of the longer side, pixels, without bars."""
    turns: list[int]
    """[C] quarter turns, counter-clockwise: phones may be held upright beside others that are not."""
    limited_by: int | None
    """Number of the camera whose pictures are far smaller than those of another; None if they are about alike."""
    wholes: Sequence[int] = ()
    """[C] the same with bars; empty if no camera has any."""
    bars: Sequence[Bars] = ()
    """[C] black bars to cut off pictures of these sizes; empty if no camera has any."""

    def whole(self, camera: int) -> int:
        """Return the largest size of the longer side of a camera's pictures before its bars are cut off."""
        return self.wholes[camera] if self.wholes else self.longest

    def shown(self, camera: int, image: np.ndarray) -> np.ndarray:
        """Cut the bars off a camera's picture [H, W, 3], and turn it."""
        return np.rot90(self.bars[camera].cut(image) if self.bars else image, self.turns[camera])

    def describe(self, names: Sequence[str]) -> list[str]:
        """Say what was changed, for the user."""
        turned = [name for name, turns in zip(names, self.turns) if turns]
        lines = (
            [f"note: pictures of {', '.join(turned)} are turned by a quarter, to have the others' size"]
            if turned
            else []
        )
        barred = [name for name, bars in zip(names, self.bars) if any(bars)]
        if barred:
            whose = "" if len(barred) == len(names) else f" of {', '.join(barred)}"
            lines.append(f"note: black bars beside the pictures{whose} are cut off")
        if self.limited_by is not None:
            small = names[self.limited_by]
            lines.append(f"note: all pictures become as small as those of {small}; without its video, they are larger")
        return lines


def common_size(videos: Sequence[Video], frames: np.ndarray, most: int, show: ShowProgress) -> CommonSize:
    """Choose a size by the first picture of each video, without black bars: that of the smallest, as most cameras are
    held.

    Args:
        frames: [C, T] indices of the frames to use.
        most: largest size of the longer side, pixels.
    """
    firsts = [next(iter(video.frames(most, {0}))).image for video in videos]
    bars = _bars(videos, firsts, frames, most, show)
    shapes = [each.cut(first).shape[:2] for each, first in zip(bars, firsts)]
    longer = [max(shape) for shape in shapes]
    upright = [height > width for height, width in shapes]
    mostly = 2 * sum(upright) + upright[0] > len(upright)
    # A phone that is held upright turns its pictures clockwise; its lens stays as it is if that is undone.
    turns = [0 if each == mostly else 3 if mostly else 1 for each in upright]
    limits = max(longer) > FAR_LARGER * min(longer)
    longest = max(min(longer), min(LEAST_SIDE, max(longer)))
    size = CommonSize(longest, turns, longer.index(min(longer)) if limits else None)
    if not any(map(any, bars)):
        return size
    scales = [min(1.0, longest / own) for own in longer]
    wholes = [round(max(first.shape[:2]) * scale) for first, scale in zip(firsts, scales)]
    scaled = [Bars(*(math.ceil(width * scale) for width in each)) for each, scale in zip(bars, scales)]
    return size._replace(wholes=tuple(wholes), bars=tuple(scaled))


def _bars(
    videos: Sequence[Video], firsts: Sequence[np.ndarray], frames: np.ndarray, most: int, show: ShowProgress
) -> list[Bars]:
    """Find the black bars of each video in some of its frames; only those are read that may have any."""
    bars, some = [Bars()] * len(videos), [number for number, first in enumerate(firsts) if are_possible(first)]
    if some:
        brightest = []
        with show(len(some), "looking for black bars") as bar:
            for number in some:
                own = np.unique(frames[number])
                wanted = {int(own[place]) for place in spread(len(own), MOST_MOMENTS)}
                bright = firsts[number].max(2)
                for frame in videos[number].frames(most, wanted):
                    bright = np.maximum(bright, frame.image.max(2))
                    wanted.remove(frame.index)
                    if not wanted:  # the rest of the film is decoded in vain
                        break
                brightest.append(bright)
                bar.advance()
        for number, found in zip(some, common_bars(brightest)):
            bars[number] = found
    return bars


def common_size_of(stored: Any, count: int) -> CommonSize | None:
    """Parse the size in a journal; None if it is malformed. Journals of earlier versions have none: all pictures are as
    they were recorded."""
    if stored is True:
        return CommonSize(0, [0] * count, None)
    if not isinstance(stored, dict) or not isinstance(stored.get("turns"), list):
        return None
    turns, limited_by = stored["turns"], stored.get("limited_by")
    numbers = [as_number(value) for value in (stored.get("longest"), *turns, limited_by or 0)]
    whole = all(number is not None and number == int(number) >= 0 for number in numbers)
    if not whole or len(turns) != count or not (limited_by or 0) < count:
        return None
    wholes, bars = stored.get("wholes", ()), stored.get("bars", ())
    try:
        cut = [Bars(*widths) for widths in bars]
        numbers = [as_number(value) for value in (*wholes, *(width for each in cut for width in each))]
    except TypeError:
        return None
    whole = all(number is not None and number == int(number) >= 0 for number in numbers)
    if not whole or len(wholes) != len(cut) or len(cut) not in (0, count):
        return None
    return CommonSize(int(stored["longest"]), [int(value) for value in turns], limited_by, tuple(wholes), tuple(cut))
