"""Cameras and colours as callers give them: arrays, lists and float64 are taken, what cannot be drawn is refused."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..types import Camera

LAST_ROWS = {"viewmat": (0.0, 0.0, 0.0, 1.0), "K": (0.0, 0.0, 1.0)}
ROUNDING = 1e-4
"""Largest error of a last row, as inverted matrices have."""


def given_camera(camera: Camera) -> Camera:
    """Return a caller's camera with float32 tensors. Numbers on a GPU are not looked at, which would wait for it.

    Raises:
        ValueError: naming the matrix or the size that is wrong.
    """
    viewmat, K = (_matrix(name, getattr(camera, name), len(row)) for name, row in LAST_ROWS.items())
    width, height = (_whole(name, getattr(camera, name)) for name in ("width", "height"))
    if width < 1 or height < 1:
        raise ValueError(f"width and height must be positive, got {width} x {height}")
    return Camera(viewmat, K, width, height)


def given_color(color: Sequence[float] | Tensor) -> Tensor:
    """Return a caller's background, [3] float32.

    Raises:
        ValueError: it is not three finite numbers.
    """
    try:
        held = torch.as_tensor(color, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"background must be 3 numbers, got {color!r:.80}") from None
    if held.shape != (3,):
        raise ValueError(f"background must be [3], got {tuple(held.shape)}")
    if held.device.type == "cpu" and not bool(held.isfinite().all()):
        raise ValueError(f"background must be finite, got {held.tolist()}")
    return held


def _matrix(name: str, value: Tensor | Sequence[Sequence[float]], size: int) -> Tensor:
    try:
        held = torch.as_tensor(value, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{name} must be a tensor of numbers, got {type(value).__name__}") from None
    if held.shape != (size, size):
        raise ValueError(f"{name} must be [{size}, {size}], got {tuple(held.shape)}")
    if held.device.type != "cpu":
        return held
    if not bool(held.isfinite().all()):
        raise ValueError(f"{name} holds NaN or infinity")
    last, wanted = held[-1].tolist(), LAST_ROWS[name]
    if any(abs(found - right) > ROUNDING for found, right in zip(last, wanted)):
        raise ValueError(f"the last row of {name} must be {list(wanted)}, got {last}; transpose or divide the matrix")
    if name == "K" and not (held[0, 0] and held[1, 1]):
        raise ValueError("K[0, 0] and K[1, 1], the focal lengths in pixels, must not be 0")
    return held


def _whole(name: str, value: object) -> int:
    try:
        whole = int(value)  # type: ignore[call-overload]
        fits = bool(whole == value)
    except (TypeError, ValueError, OverflowError):
        fits = False
    if not fits:
        raise ValueError(f"{name} must be a whole number, got {value!r:.80}")
    return whole
