"""Folders that results go to: found writable before the work, and replaced as a whole after it."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

from ..errors import UserError


def make_parent(path: Path) -> None:
    """Make the folder that ``path`` is to stand in.

    Raises:
        UserError: it cannot be made, or nothing can be written there.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        raise UserError(f"{path.parent}: cannot be written ({error.strerror}); give another output folder") from None


def holds_only(folder: Path, pattern: str) -> bool:
    """Whether all names in it match a regular expression: such a folder may be replaced."""
    return all(re.fullmatch(pattern, entry.name) for entry in folder.iterdir())


def replace_folder(path: Path, new: Path) -> None:
    """Put the folder ``new`` in the place of ``path``, which is removed once the new one stands there.

    Raises:
        OSError: that cannot be; the earlier folder stands where it stood.
    """
    if not path.is_dir():
        os.replace(new, path)
        return
    old = path.with_name(f".{path.name}.{os.getpid()}.old")
    os.replace(path, old)
    try:
        os.replace(new, path)
    except BaseException:
        os.replace(old, path)
        raise
    shutil.rmtree(old, ignore_errors=True)
