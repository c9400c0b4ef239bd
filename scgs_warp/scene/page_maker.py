"""Link from a scene to the code that makes its page for notebooks. That code belongs to a higher layer, which registers
itself here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

_makers: list[Callable[[Any], str | None]] = []


def register(maker: Callable[[Any], str | None]) -> None:
    """Let ``maker(scene)`` make the pages of scenes."""
    _makers[:] = [maker]


def page(scene: Any) -> str | None:
    """Return a scene's page as an HTML element; None if it has none."""
    return _makers[0](scene) if _makers else None
