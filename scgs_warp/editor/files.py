"""Paths of the editor's files: one folder, plain names."""

from __future__ import annotations

import re
from pathlib import Path

from ..errors import UserError

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,99}")


def output_path(folder: Path, name: str, suffix: str) -> Path:
    """Return the path of a file in the folder, and make the folder if it is missing. Names come from browsers, so no
    name may lead out of the folder.

    Args:
        name: file name with or without its suffix.

    Raises:
        UserError: the name contains other characters than letters, digits, spaces, dots and dashes, the file is a link,
            or the folder cannot be made.
    """
    name = _bare(name, suffix)
    if not _good(name):
        raise UserError(f"file name {name[:100]!r}: take letters, digits, spaces, dots and dashes, a letter first")
    path = folder / f"{name}{suffix}"
    if path.is_symlink():
        raise UserError(f"{path.name}: is a link; take another name")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made ({error.strerror}); give another --folder") from None
    return path


def _bare(name: str, suffix: str) -> str:
    name = name.strip()
    return name[: -len(suffix)] if name.lower().endswith(suffix) else name


def _good(name: str) -> bool:
    return bool(NAME.fullmatch(name)) and not name.endswith((".", " "))


def unused_path(path: Path) -> Path:
    """Return the path, or, if it exists, the first of ``name 2``, ``name 3`` ... that does not."""
    candidate, number = path, 1
    while candidate.exists() or candidate.is_symlink():
        number += 1
        ending = f" {number}{path.suffix}"
        candidate = path.with_name(path.name.removesuffix(path.suffix)[: 100 - len(ending)].rstrip(". ") + ending)
    return candidate


def saved_edits(folder: Path) -> tuple[str, ...]:
    """List the saved edits whose names ``output_path`` accepts."""
    if not folder.is_dir():
        return ()
    paths = sorted(folder.glob("*.json"))
    return tuple(path.name for path in paths if _good(_bare(path.name, ".json")) and not path.is_symlink())
