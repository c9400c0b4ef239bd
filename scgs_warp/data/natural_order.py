"""Natural order of names: ``frame_9`` comes before ``frame_10``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path


def natural(text: str) -> list[tuple[int, str]]:
    """Return the key that sorts ``text`` in natural order."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", text) if part]


def by_name(files: Sequence[Path]) -> list[int]:
    """Return the indices of ``files`` in the natural order of their names."""
    return sorted(range(len(files)), key=lambda index: natural(files[index].as_posix()))
