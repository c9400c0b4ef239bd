"""Comparison of the thumbnails that checkpoints record, by which data sets with the same names are told apart."""

from __future__ import annotations

from typing import Any

ALIKE = 3
"""Largest difference, in levels of 255, between thumbnails of equal images: decoders and filters round differently."""


def differ(recorded: Any, found: str) -> bool:
    """Return whether images differ from those of which thumbnails were recorded; False if either has none, as runs of
    earlier versions."""
    if not isinstance(recorded, str) or not recorded or not found:
        return False
    try:
        then, now = bytes.fromhex(recorded), bytes.fromhex(found)
    except ValueError:
        return False
    return len(then) != len(now) or any(abs(one - other) > ALIKE for one, other in zip(then, now))
