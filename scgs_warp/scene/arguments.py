"""Cameras and colours as callers give them: arrays, lists and float64 are taken, what cannot be drawn is refused."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import UserError
from ..ops.shapes import given_whole, shown
from ..types import Camera

LAST_ROWS = {"viewmat": (0.0, 0.0, 0.0, 1.0), "K": (0.0, 0.0, 1.0)}
ROUNDING = 1e-4
"""Largest error of a last row, as inverted matrices have."""


def given_camera(camera: Camera) -> Camera:
    """Return a caller's camera with float32 tensors. Numbers on a GPU are not looked at, which would wait for it.

    Raises:
        ValueError: naming the matrix or the size that is wrong.
    """
    if not all(hasattr(camera, name) for name in (*LAST_ROWS, "width", "height")):
        raise ValueError(f"camera must be a scgs_warp.Camera(viewmat, K, width, height), got {type(camera).__name__}")
    viewmat, K = (_matrix(name, getattr(camera, name), len(row)) for name, row in LAST_ROWS.items())
    width, height = (given_whole(name, getattr(camera, name)) for name in ("width", "height"))
    if width < 1 or height < 1:
        raise ValueError(f"width and height must be positive, got {width} x {height}")
    return Camera(viewmat, K, width, height)


def given_color(color: Sequence[float] | Tensor) -> Tensor:
    """Return a caller's background, [3] float32.

    Raises:
        ValueError: it is not three finite numbers.
    """
    try:
        held = _numbers(color)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"background must be 3 numbers, got {color!r:.80}") from None
    if held.shape != (3,):
        raise ValueError(f"background must be [3], got {tuple(held.shape)}")
    if held.device.type == "cpu" and not bool(held.isfinite().all()):
        raise ValueError(f"background must be finite, got {held.tolist()}")
    return held


def given_scalar(name: str, value: float | Tensor, wanted: str) -> float:
    """Return a time or another finite number that a caller gives.

    Args:
        wanted: what the argument must be, for the message.

    Raises:
        UserError: it is no number, or non-finite.
    """
    if isinstance(value, Tensor):
        value = value.detach()
    try:
        fits = math.isfinite(value)
    except (TypeError, ValueError, RuntimeError):  # RuntimeError: a tensor of several numbers
        fits = False
    if not fits:
        raise UserError(f"{name} is {shown(value)}; give {wanted}")
    return float(value)


def clamped_time(time: float) -> float:
    """Clamp ``time`` to [0, 1].

    Raises:
        UserError: the time is no number, or non-finite.
    """
    return min(max(given_scalar("time", time, "a number from 0 (the first moment) to 1 (the last)"), 0.0), 1.0)


def _numbers(value: Any) -> Tensor:
    """Return a caller's numbers in float32. torch takes no flipped array and none of another byte order, and warns of
    those that may not be written."""
    held = np.array(value, np.float32, order="C") if isinstance(value, np.ndarray) else value
    return torch.as_tensor(held, dtype=torch.float32)


def _matrix(name: str, value: Tensor | Sequence[Sequence[float]], size: int) -> Tensor:
    try:
        held = _numbers(value)
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
