"""Check of the shapes that the ops declare."""

from __future__ import annotations

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
