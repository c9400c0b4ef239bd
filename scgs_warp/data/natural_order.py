"""Natural order of names: ``frame_9`` comes before ``frame_10``, and ``1548266469.8`` before ``1548266469.85466``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

NUMBER = re.compile(r"((?<![0-9.])1[0-9]{9}\.[0-9]+|[0-9]+)")
"""Whole numbers, and seconds since 1970 with their decimals; in shorter numbers a dot may separate anything."""


def natural(text: str) -> list[tuple[Fraction | int, str]]:
    """Return the key that sorts ``text`` in natural order."""
    parts = enumerate(NUMBER.split(text))  # every second part is a number
    return [
        (-1, part) if index % 2 == 0 else (Fraction(part) if "." in part else int(part), "")
        for index, part in parts
        if part
    ]


def by_name(files: Sequence[Path]) -> list[int]:
    """Return the indices of ``files`` in the natural order of their names."""
    return sorted(range(len(files)), key=lambda index: natural(files[index].as_posix()))
