"""Copies from the host to a device for which the host does not wait."""

from __future__ import annotations

import torch
from torch import Tensor


def pinned(values: Tensor, device: torch.device) -> Tensor:
    """Return the values in pinned memory if they go from the host to a GPU, otherwise as they are."""
    crosses = device.type == "cuda" and values.device.type == "cpu"
    return values.pin_memory() if crosses else values


def sent(values: Tensor, device: torch.device) -> Tensor:
    """Return the values on ``device``.

    To a GPU they are copied from pinned memory, in the order of the current stream: the host goes on at once, and may
    change or drop ``values``. A copy from pageable memory would make it wait.
    """
    ready = pinned(values, device)
    return ready.to(device, non_blocking=ready is not values)
