"""Where the editor's files go: one folder, plain names."""

from __future__ import annotations

import re
from pathlib import Path

from ..errors import UserError

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,99}")


def place(folder: Path, name: str, suffix: str) -> Path:
    """A file in the folder, which is made; users' browsers may be anywhere, so nothing leads out of it.

    Args:
        name: with or without its suffix.

    Raises:
        UserError: the name has anything in it but letters, digits, spaces, dots, dashes, or the folder cannot be made.
    """
    name = name.strip()
    if name.lower().endswith(suffix):
        name = name[: -len(suffix)]
    if not NAME.fullmatch(name) or name.endswith((".", " ")):
        raise UserError(f"file name {name[:100]!r}: take letters, digits, spaces, dots and dashes, a letter first")
    path = folder / f"{name}{suffix}"
    if path.is_symlink():
        raise UserError(f"{path.name}: is a link; take another name")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made ({error.strerror}); give another --folder") from None
    return path


def edits(folder: Path) -> tuple[str, ...]:
    """Names of the saved edits."""
    return tuple(sorted(path.name for path in folder.glob("*.json"))) if folder.is_dir() else ()
