"""Readers that break the law, each in another way: they show that the campaign detects it."""

from __future__ import annotations

import os
import time
import warnings
from pathlib import Path

import numpy as np

from fuzz.files_cases import Format, finite
from scgs_warp.errors import UserError


def _make(folder: Path) -> None:
    folder.mkdir()
    (folder / "a.txt").write_text("1 2 3\n")


def _sound(folder: Path) -> bool:
    """Raise if files are damaged during preparation."""
    file = folder / "a.txt"
    return file.is_file() and file.read_bytes() == b"1 2 3\n"


def _wait(folder: Path) -> None:
    time.sleep(0 if _sound(folder) else 3600)


def _die(folder: Path) -> None:
    if not _sound(folder):
        os.abort()


def _raise(folder: Path) -> None:
    if not _sound(folder):
        raise KeyError("a field")


def _return_nan(folder: Path) -> None:
    finite("the answer", 1.0 if _sound(folder) else float("nan"))


def _swallow(folder: Path) -> None:
    if not _sound(folder):
        np.ones(95_000_000)  # 725 MiB


def _swallow_all(folder: Path) -> None:
    if not _sound(folder):
        np.ones(10**12)


def _name_nothing(folder: Path) -> None:
    if not _sound(folder):
        raise UserError("something is wrong")


def _warn(folder: Path) -> None:
    if not _sound(folder):
        warnings.warn("divide by zero", RuntimeWarning, stacklevel=1)


FORMATS = tuple(
    Format(name, _make, load)
    for name, load in (
        ("hang", _wait), ("crash", _die), ("traceback", _raise), ("broken law", _return_nan), ("memory", _swallow),
        ("out of memory", _swallow_all), ("untidy", _name_nothing), ("warned", _warn),
    )
)  # fmt: skip
"""Formats named after their expected outcome."""
