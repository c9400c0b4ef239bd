"""Selection of held-out frames for data sets that list no splits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import UserError

HELD_OUT_EVERY = 8
HELD_OUT_FIRST = 4
"""Index of the first held-out frame. Frames 4, 12, 20, ... are held out, never frame 0, so that no held-out time has to
be extrapolated."""


def held_out(path: Path, order: Sequence[int], split: str) -> list[int]:
    """Return the frame indices of one split, ascending; ``test`` and ``val`` are the same held-out frames.

    Args:
        path: file that lists the frames, named in the message.
        order: indices of all frames in the order in which every eighth is held out.
        split: ``train``, ``test`` or ``val``.

    Raises:
        UserError: the split would be empty.
    """
    outside = set(order[min(HELD_OUT_FIRST, len(order) - 1) :: HELD_OUT_EVERY])
    chosen = [index for index in sorted(order) if (index in outside) != (split == "train")]
    if not chosen:
        raise UserError(f"{path}: one frame cannot be both trained on and held out; list at least two frames")
    return chosen
