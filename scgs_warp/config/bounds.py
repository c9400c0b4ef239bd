"""Declarations of numbers with bounds, for the fields of a configuration; ``validation.py`` checks the bounds."""

from __future__ import annotations

from dataclasses import field
from typing import Any

MAGNITUDE = 1e9
"""Largest value of a number without a limit of its own."""
MOST_NODES = 20_000
"""Largest number of control points that may be asked for. Where fewer places offer themselves, fewer are made, so that
runs may have recorded a larger number."""


def bounded(default: float, least: float, most: float = MAGNITUDE, **more: Any) -> Any:
    """Declare a number with inclusive bounds. ``most`` also limits sizes that take memory, because a configuration may
    come from an untrusted file."""
    return field(default=default, metadata={"least": least, "most": most, **more})


def rate(default: float, **more: Any) -> Any:
    """Declare a learning rate of Adam: at a rate of 1, every step moves a parameter by about 1."""
    return bounded(default, 0, 1, **more)


def chosen(default: int, least: int, most: int) -> Any:
    """Declare a whole number with inclusive bounds, few enough that the error message offers all values as choices."""
    return field(default=default, metadata={"choices": (least, most)})


def newer(default: Any, before: Any, **bounds: Any) -> Any:
    """Declare a field that older versions did not have; ``before`` is the value that does what they did. Numbers need
    bounds as in :func:`bounded`."""
    if "least" in bounds:
        return bounded(default, before=before, **bounds)
    return field(default=default, metadata={"before": before})


def milestone(steps: int, least: int = 0) -> Any:
    """Declare a step count that scales with the length of the run."""
    return bounded(steps, least, milestone=True)
