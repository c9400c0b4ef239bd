"""Link from a scene to the code that films it. That code belongs to a higher layer, which registers itself here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

_makers: list[Callable[..., Path]] = []


def register(maker: Callable[..., Path]) -> None:
    """Let ``maker(scene, path, **options)`` write the films of scenes."""
    _makers[:] = [maker]


def film(scene: Any, path: str | Path, **options: Any) -> Path:
    """Write a film of a scene."""
    return _makers[0](scene, path, **options)
