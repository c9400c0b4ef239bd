"""Checks of shapes and numbers that callers give."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torch import Tensor


def check_shapes(expected: Mapping[str, tuple[Tensor | None, tuple[int, ...]]]) -> None:
    """Compare tensors, by their names, with the shapes that they must have; None: not given.

    Raises:
        ValueError: names the first tensor of another shape, and both shapes.
    """
    for name, (value, shape) in expected.items():
        if value is not None and tuple(value.shape) != shape:
            raise ValueError(f"{name} must be {list(shape)}, got {list(value.shape)}")


def shown(value: object) -> str:
    """Return what a caller gave for an error message: one line of at most 80 characters."""
    return " ".join(repr(value).split())[:80]


def given_whole(name: str, value: object) -> int:
    """Return a whole number that a caller gives, also as 40.0 or as a tensor.

    Raises:
        ValueError: names the argument.
    """
    try:
        whole = int(value)  # type: ignore[call-overload]
        fits = bool(whole == value)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        fits = False
    if not fits:
        raise ValueError(f"{name} must be a whole number, got {shown(value)}")
    return whole


def given_number(name: str, value: object) -> float:
    """Return a number that a caller gives, which may be infinite.

    Raises:
        ValueError: names the argument.
    """
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError, RuntimeError):
        number = math.nan
    if math.isnan(number):
        raise ValueError(f"{name} must be a number, got {shown(value)}")
    return number
