"""Choice of frames before any image is read: by instant, by camera, and by the presence of the image."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from numbers import Real
from pathlib import Path
from typing import NamedTuple

from ..errors import UserError
from .images import ReadOptions

NAMED = 3
"""Largest number of names in a message."""


class Choice(NamedTuple):
    """Chosen frames of those that a file lists."""

    indices: list[int]
    """Ascending indices of the chosen frames."""
    times: list[float]
    """Times of all listed frames; if instants were chosen, scaled so that the chosen ones go from 0 to 1."""
    notes: tuple[str, ...]
    """Lines that the user should read."""


class Instants(NamedTuple):
    """Instants that ``--frames`` chooses."""

    chosen: frozenset[float]
    first: float
    last: float

    def scaled(self, times: Sequence[float]) -> list[float]:
        """Scale times so that the chosen instants go from 0 to 1."""
        length = self.last - self.first
        return [(time - self.first) / length if length > 0 else 0.0 for time in times]


def check_choice(options: ReadOptions) -> None:
    """Raise UserError for an invalid choice of frames."""
    for name, value, example in (("frames", options.frames, "0:300:2"), ("only_cameras", options.only_cameras, "a,b")):
        if not isinstance(value, str | None):
            raise UserError(f"{name} is {value!r:.80}; give a text, such as {example!r}")
    _slice(options.frames)
    if options.only_cameras and not _names(options.only_cameras):
        raise UserError(f"--only-cameras {options.only_cameras}: name cameras, separated by commas")
    if not (isinstance(options.min_frames, Real) and 0 <= options.min_frames < math.inf):
        raise UserError(f"--min-frames {options.min_frames!r:.80}: give at least 1, or 0 for half of the frames")


def _slice(text: str) -> slice | None:
    """Parse ``A:B:C`` as Python does; None for an empty text."""
    if not text:
        return None
    match = re.fullmatch(r"\s*(-?\d{1,9})?\s*:\s*(-?\d{1,9})?\s*(?::\s*(\d{1,9})?\s*)?", text)
    if match is None or (match[3] is not None and int(match[3]) == 0):
        raise UserError(f"--frames {text}: write A:B or A:B:C (first, end, step), for example 0:300:2 or 100:")
    return slice(*(None if part is None else int(part) for part in match.groups()))


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def choose_instants(times: Sequence[float], options: ReadOptions) -> Instants | None:
    """Choose instants of the distinct ``times``, in their order; None if all are wanted.

    Raises:
        UserError: none is chosen.
    """
    wanted = _slice(options.frames)
    if wanted is None:
        return None
    instants = sorted(set(times))
    chosen = instants[wanted]
    if not chosen:
        raise UserError(f"--frames {options.frames}: chooses none of the {len(instants)} instants; give A below B")
    return Instants(frozenset(chosen), chosen[0], chosen[-1])


def of_cameras(cameras: Sequence[str], options: ReadOptions) -> list[int]:
    """Return the indices of the entries of ``cameras`` that ``--only-cameras`` names, all of them if it names none.

    Raises:
        UserError: a name is not among ``cameras``.
    """
    wanted = set(_names(options.only_cameras))
    if not wanted:
        return list(range(len(cameras)))
    known = list(dict.fromkeys(name for name in cameras if name))
    for name in sorted(wanted - set(known)):
        there = f"choose of {_listed(known, 12)}" if known else "this layout does not name any"
        raise UserError(f"--only-cameras {name}: no frame is of this camera; {there}")
    return [index for index, name in enumerate(cameras) if name in wanted]


def held_camera(cameras: Sequence[str], options: ReadOptions) -> str:
    """Return the name of the held-out camera of a rig: the one that ``--only-cameras`` names first or, if it names
    none, the first of ``cameras``."""
    return next(iter(_names(options.only_cameras)), cameras[0])


def choose(
    where: Path,
    files: Sequence[Path],
    times: Sequence[float],
    options: ReadOptions,
    cameras: Sequence[str] | None = None,
    remedy: str = "restore them",
) -> Choice:
    """Choose the frames of a list: those of the wanted instants and cameras whose images exist.

    Args:
        where: file that lists the frames, named in messages.
        cameras: name of each frame's camera; None: they are all wanted.
        remedy: what to do about missing images.

    Raises:
        UserError: nothing is chosen, or too many images are missing.
    """
    instants = choose_instants(times, options)
    indices = list(range(len(files))) if cameras is None else of_cameras(cameras, options)
    if instants is not None:
        indices = [index for index in indices if times[index] in instants.chosen]
        if not indices:
            raise UserError(f"{where}: no frame is of the cameras and instants that --only-cameras and --frames choose")
    kept, notes = present(where, files, indices, options, remedy)
    kept, repeated = _once(where, files, times, kept)
    return Choice(kept, list(times) if instants is None else instants.scaled(times), (*notes, *repeated))


def _once(
    where: Path, files: Sequence[Path], times: Sequence[float], indices: Sequence[int]
) -> tuple[list[int], tuple[str, ...]]:
    """Return the ``indices`` without frames that repeat the image and time of an earlier one, and a note on these. A
    repeated frame could be held out and trained on at the same time."""
    first: dict[tuple[Path, float], int] = {}
    for index in indices:
        first.setdefault((files[index], times[index]), index)
    kept = list(first.values())
    repeated = sorted(set(indices) - set(kept))
    if not repeated:
        return kept, ()
    names = _listed([files[index].name for index in repeated], NAMED)
    return kept, (
        f"{where}: {len(repeated)} of {len(indices)} frames are left out, because they repeat others ({names})",
    )


def present(
    where: Path, files: Sequence[Path], indices: Sequence[int], options: ReadOptions, remedy: str = "restore them"
) -> tuple[list[int], tuple[str, ...]]:
    """Return the ``indices`` whose files exist, and a note on the others.

    Raises:
        UserError: fewer than ``min_frames`` remain or, if this is 0, less than half.
    """
    kept = [index for index in indices if files[index].is_file()]
    count, total = len(indices) - len(kept), len(indices)
    if count == 0:
        return kept, ()
    there = set(kept)
    names = _listed([files[index].name for index in indices if index not in there], NAMED)
    least = options.min_frames or -(-total // 2)
    if len(kept) < max(least, 1):
        rest = f", or pass --min-frames {len(kept)} to use the other {len(kept)}" if kept else ""
        raise UserError(f"{where}: the images of {count} of {total} frames are missing ({names}); {remedy}{rest}")
    return kept, (f"{where}: {count} of {total} frames are left out, because their images are missing ({names})",)


def _listed(names: Sequence[str], most: int) -> str:
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")
