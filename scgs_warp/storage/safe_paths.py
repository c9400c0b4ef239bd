"""Validation of paths named in other people's files: a path must lie inside the file's own folder.

A data set or a model may come from a stranger. A name that leads out of its folder (``..``, another root, a drive) is
refused, as is anything but a regular file: ``/dev/zero`` never ends. Links in the folder are followed: its owner put
them there.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Sequence
from pathlib import Path

from ..errors import UserError

LONGEST_NAME, LONGEST_PATH = 240, 2000
"""Limits in bytes. File systems allow 255 per name and 4096 per path, and suffixes may be added."""


def inside(folder: Path, name: str, where: str, what: str = "file") -> Path:
    """Return the path of ``name`` in ``folder``; both slashes and backslashes are separators.

    Args:
        where: file and field that hold the name; begins the message.
        what: kind of file that is named, for the message.

    Raises:
        UserError: the name is empty, is no valid path, or leads out of the folder.
    """
    text = name.replace("\\", "/")
    if not text.strip() or "\0" in text or not _fits(text):
        raise UserError(f"{where} is {name[:60]!r}, which names no file; name the {what}")
    base = os.path.abspath(folder)
    path = os.path.normpath(os.path.join(base, text))
    if re.match(r"[A-Za-z]:/", text) or not path.startswith(os.path.join(base, "")):
        raise UserError(
            f"{where} is {name[:60]!r}, which leads out of {folder}; put the {what}, or a link to it, there"
        )
    return folder / os.path.relpath(path, base)


def _fits(text: str) -> bool:
    try:
        size = len(os.fsencode(text))
    except UnicodeEncodeError:  # half of a surrogate pair
        return False
    return size <= LONGEST_PATH and all(len(os.fsencode(part)) <= LONGEST_NAME for part in text.split("/"))


def in_any_case(file: Path) -> Path | None:
    """Return the file, or the one in its folder whose name differs only in upper and lower case; None without either.
    Windows and macOS ignore the case of names, so data sets made there may mix it."""
    if file.is_file():
        return file
    wanted = file.name.lower()
    try:
        with os.scandir(file.parent) as entries:
            found = sorted(entry.name for entry in entries if entry.name.lower() == wanted)
    except OSError:
        return None
    return file.with_name(found[0]) if found and file.with_name(found[0]).is_file() else None


def first_there(files: Sequence[Path]) -> Path | None:
    """Return the first of the files that exists or, without any, of those whose names differ only in upper and lower
    case."""
    exact = next((file for file in files if file.is_file()), None)
    return exact or next((found for file in files if (found := in_any_case(file)) is not None), None)


def is_regular(path: Path) -> bool:
    """Return whether ``path`` is a regular file, not a folder, pipe or device.

    Raises:
        OSError: it does not exist or cannot be examined.
    """
    return stat.S_ISREG(path.stat().st_mode)
