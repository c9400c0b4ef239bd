"""Output folders, which are checked before work begins and replaced as a whole after it."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

from ..errors import UserError


def make_parent(path: Path) -> None:
    """Make the parent folder of ``path``.

    Raises:
        UserError: it cannot be made, or is not writable.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        raise UserError(f"{path.parent}: cannot be written ({error.strerror}); give another output folder") from None


def holds_only(folder: Path, pattern: str) -> bool:
    """Return whether a folder may be replaced: all names in it match a regular expression."""
    return all(re.fullmatch(pattern, entry.name) for entry in folder.iterdir())


def replace_folder(path: Path, new: Path) -> None:
    """Replace the folder ``path`` by the folder ``new``, and remove the earlier one afterwards.

    Raises:
        OSError: replacing failed; the earlier folder is back in its place.
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
