"""One size for the pictures of all cameras of a rig: a data set has only one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from ...storage.json_files import as_number
from ..source import Video

LEAST_SIDE = 480
"""Longer side to which pictures are reduced at most, for that of a smaller one: cameras are found with them. Beyond it,
they are cut."""
FAR_LARGER = 1.4
"""Ratio of the longer sides of two cameras' pictures above which the smaller one is worth a note."""


class CommonSize(NamedTuple):
    """How the pictures of C cameras come to have about one size."""

    longest: int
    """Largest size of the longer side, pixels."""
    turns: list[int]
    """[C] quarter turns, counter-clockwise: phones may be held upright beside others that are not."""
    limited_by: int | None
    """Number of the camera whose pictures are far smaller than those of another; None if they are about alike."""

    def describe(self, names: Sequence[str]) -> list[str]:
        """Say what was changed, for the user."""
        turned = [name for name, turns in zip(names, self.turns) if turns]
        lines = (
            [f"note: pictures of {', '.join(turned)} are turned by a quarter, to have the others' size"]
            if turned
            else []
        )
        if self.limited_by is not None:
            small = names[self.limited_by]
            lines.append(f"note: all pictures become as small as those of {small}; without its video, they are larger")
        return lines


def common_size(videos: Sequence[Video], most: int) -> CommonSize:
    """Choose a size by the first picture of each video: that of the smallest, as most cameras are held.

    Args:
        most: largest size of the longer side, pixels.
    """
    shapes = [next(iter(video.frames(most, {0}))).image.shape[:2] for video in videos]
    longer = [max(shape) for shape in shapes]
    upright = [height > width for height, width in shapes]
    mostly = 2 * sum(upright) + upright[0] > len(upright)
    # A phone that is held upright turns its pictures clockwise; its lens stays as it is if that is undone.
    turns = [0 if each == mostly else 3 if mostly else 1 for each in upright]
    limits = max(longer) > FAR_LARGER * min(longer)
    return CommonSize(
        max(min(longer), min(LEAST_SIDE, max(longer))), turns, longer.index(min(longer)) if limits else None
    )


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
    return CommonSize(int(stored["longest"]), [int(value) for value in turns], limited_by)
