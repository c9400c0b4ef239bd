"""The place where a scene finds what makes its page for notebooks; pages belong to a higher floor."""

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
