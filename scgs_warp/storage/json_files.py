"""JSON: reading of what others wrote, and of the numbers in it, and writing."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from .files import read_text, write_atomically


def parse_json(text: str | bytes, **hooks: Any) -> Any:
    """Parse JSON as ``json.loads`` does, also after the mark that editors of Windows put before a text, but raise
    ValueError for brackets that are nested too deeply.

    Raises:
        ValueError: the text is not valid JSON; a ``json.JSONDecodeError`` where the position is known.
    """
    try:
        return json.loads(text.removeprefix("\ufeff") if isinstance(text, str) else text, **hooks)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def read_json(path: Path, needed: str = "restore it") -> dict[str, Any]:
    """Read the JSON object in ``path``.

    Args:
        needed: why the file is needed, or the remedy; ends the message if the file is missing.

    Raises:
        UserError: the file is missing, is not JSON, or holds something other than an object.
    """
    try:
        text = read_text(path)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; {needed}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); restore the file") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: is no UTF-8 text; save it as UTF-8, or restore it") from None
    try:
        content = parse_json(text)
    except json.JSONDecodeError as error:
        raise UserError(
            f"{path}: not valid JSON, line {error.lineno} column {error.colno}: {error.msg}; restore or correct it"
        ) from None
    except ValueError as error:  # nested too deeply, or Python's own limit of 4,300 digits
        reason = "JSON nested too deeply" if "nested" in str(error) else "holds a number of more than 4,300 digits"
        raise UserError(f"{path}: {reason}; restore or correct the file") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: holds no JSON object; restore the file")
    return content


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically, one value a line.

    Raises:
        UserError: the file cannot be written; an earlier one is intact.
    """
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode("utf-8"))


def as_number(value: Any) -> float | None:
    """Return a finite number as float, and None for anything else, including bool and strings."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def as_array(value: Any, *shapes: tuple[int, ...]) -> np.ndarray | None:
    """Return a finite float64 array of one of ``shapes``, and None for anything else, as :func:`numbers` does."""
    array = numbers(value)
    return array if array is not None and array.shape in shapes and np.isfinite(array).all() else None


def numbers(value: Any) -> np.ndarray | None:
    """Return nested lists of numbers as a float64 array of their shape, which may hold NaN and infinity.

    None stands for anything else: rows of different lengths, and bool and strings, which NumPy would convert.
    """
    if not _only_numbers(value):
        return None
    try:
        return np.array(value, np.float64)
    except (ValueError, OverflowError):
        return None


def _only_numbers(value: Any, depth: int = 4) -> bool:
    if isinstance(value, (list, tuple)):
        return depth > 0 and all(_only_numbers(item, depth - 1) for item in value)
    return isinstance(value, (int, float)) and not isinstance(value, bool)
