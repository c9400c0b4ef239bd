"""Names that stand in files of others: they say where in the file's own folder something lies, and nowhere else.

A data set or a model may come from a stranger. What leads out of its folder (``..``, another root, a drive) is refused,
as is what is no file at all, such as ``/dev/zero``, which never ends. Links that lie in the folder are followed: its
owner put them there.
"""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path

from ..errors import UserError

LONGEST_NAME, LONGEST_PATH = 240, 2000
"""Bytes; file systems have 255 and 4096, and something may be added."""


def inside(folder: Path, name: str, where: str, what: str = "file") -> Path:
    """The path of ``name`` in ``folder``; slashes of either kind.

    Args:
        where: what names it, for the message: file and field.
        what: kind of thing that is named.

    Raises:
        UserError: it is empty, can be no path, or leads out of the folder.
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
    except UnicodeEncodeError:  # half a letter
        return False
    return size <= LONGEST_PATH and all(len(os.fsencode(part)) <= LONGEST_NAME for part in text.split("/"))


def is_regular(path: Path) -> bool:
    """Whether it can be read as a file, to its end: no pipe, no device.

    Raises:
        OSError: there is no such thing, or it cannot be looked at.
    """
    return stat.S_ISREG(path.stat().st_mode)
