"""Names of the coordinate axes."""

from __future__ import annotations

from typing import Literal

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


def direction(axis: Axis) -> tuple[float, float, float]:
    """Return the unit vector of an axis."""
    sign = -1.0 if axis[0] == "-" else 1.0
    x, y, z = (sign if axis[-1] == name else 0.0 for name in "xyz")
    return x, y, z
