"""Errors for scenes that have no surface: the code that notices it gives the reason, and the code that opened the
scene adds its source and the remedy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import UserError


class NoSurface(UserError):
    """The scene has no surface; the message is the reason."""


@contextmanager
def explained(run: Path | None, file: Path | None) -> Iterator[None]:
    """Name the source of the scene, and the remedy.

    Args:
        run: the run from which the scene comes; None: it comes from ``file``.

    Raises:
        UserError: in place of a ``NoSurface``.
    """
    try:
        yield
    except NoSurface as error:
        remedy = "give another file" if run is None else "train for more steps"
        view = f"--run {run}" if run is not None else f"--ply {file}"
        raise UserError(f"{run or file}: {error}; {remedy}, or look at it with apps/view.py {view}") from None
