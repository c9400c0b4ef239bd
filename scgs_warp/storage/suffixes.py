"""Suffixes of file names, of which the longest decides: ``x.compressed.ply`` is no ``.ply``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path


def longest_suffix(path: str | Path, suffixes: Iterable[str]) -> str:
    """Return the longest of ``suffixes`` that the last part of a path ends in, whatever its case; "" if there is none.

    Args:
        suffixes: in lower case. One that begins with a dot needs a name before it; any other, such as ``meta.json``,
            must be the whole name.
    """
    name = Path(path).name.lower()
    found = [s for s in suffixes if (name.endswith(s) and len(name) > len(s) if s.startswith(".") else name == s)]
    return max(found, key=len, default="")
