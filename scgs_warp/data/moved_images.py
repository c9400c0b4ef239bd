"""Images that are not where their data set says, because it was written on another machine or from another folder, or
because the folder of images has another name now."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

from .dataset import spread

PLACES = ("", "images", "input", "rgb", "frames", "color", "image", "imgs")
"""Folders in which images are looked for, below that of the data set."""
MOST_PROBES = 16
"""Number of names that are tried first."""


class Move(NamedTuple):
    """Where the images are: each name without its first folders, in a folder."""

    dropped: int
    place: str

    def of(self, name: str) -> str | None:
        """Return the name of a file relative to the data set's folder; None if it is a name of folders alone."""
        parts = parts_of(name)[self.dropped :]
        return "/".join([*([self.place] if self.place else []), *parts]) if parts else None


def parts_of(name: str) -> list[str]:
    """Split a name, an address (``file://``) or a name with escapes (``%20``) into folders and file."""
    text = name.removeprefix("file://").replace("\\", "/")
    return [part for part in text.split("/") if part not in ("", ".", "..")]


def find_move(
    names: Sequence[str], find: Callable[[str], Path | None], further: Sequence[str] = ()
) -> tuple[Move, list[Path | None]] | None:
    """Find the place of images of which none is where its name says.

    One place must hold at least half of the images, and no file may stand for two names: images of another camera or
    another scene are not taken.

    Args:
        find: function from a name relative to the data set's folder to the file of an image, None if there is none.
        further: folders in which to look last.

    Returns:
        The place, and the file of each name.
    """
    known = list(dict.fromkeys(names))
    deepest = max((len(parts_of(name)) for name in known), default=0)
    for dropped in range(deepest):
        for place in (*PLACES, *further):
            move = Move(dropped, place)

            def look(name: str, move: Move = move) -> Path | None:
                there = move.of(name)
                found = None if there is None else find(there)
                return find(unquote(there)) if found is None and there is not None and "%" in there else found

            probes = [look(known[index]) for index in spread(len(known), MOST_PROBES)]
            if 2 * sum(file is not None for file in probes) < len(probes):
                continue
            files = {name: look(name) for name in known}
            there = [file for file in files.values() if file is not None]
            if 2 * len(there) >= len(known) and len(set(there)) == len(there):
                return move, [files[name] for name in names]
    return None
