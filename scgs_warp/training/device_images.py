"""Training images kept in the memory of a GPU, so that a step copies none from the host."""

from __future__ import annotations

from collections.abc import Callable, Hashable

import torch
from torch import Tensor

from ..runtime import memory
from ..runtime.device_copies import sent

MEMORY_SHARE = 0.3
"""Largest share that images may take of the device's memory that is free at the start."""


class DeviceImages:
    """Copies of images on a device, made at their first use. On a CPU nothing is copied.

    Values that are multiples of 1/255, as those of a decoded file, are kept as bytes, others as float32: nothing is
    lost. Images beyond the memory's share are copied from the host at each use. Images are given as functions, called
    only if there is no copy, so that a file need not be decoded again.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.budget = int(MEMORY_SHARE * memory.room(device)) if device.type == "cuda" else 0
        self.used = 0
        self._kept: dict[Hashable, Tensor] = {}
        # A number of the host will not do: torch multiplies by its reciprocal, which rounds differently.
        self._most = sent(torch.tensor(255.0), device)

    def hold(self, key: Hashable) -> bool:
        """Return whether there is a copy of the image of this key."""
        return key in self._kept

    def planar(self, key: Hashable, image: Callable[[], Tensor]) -> Tensor:
        """Return the image [H, W, 3] as [3, H, W] on the device; the same key must stand for the same image."""
        kept = self._kept.get(key)
        if kept is None:
            planes = image().permute(2, 0, 1).contiguous()
            room = self.used + planes.numel() <= self.budget
            kept = self._copy(key, _smallest(planes) if room else planes)
        return kept.float() / self._most if kept.dtype == torch.uint8 else kept

    def plane(self, key: Hashable, values: Callable[[], Tensor]) -> Tensor:
        """Return the values [H, W] on the device; the same key must stand for the same values."""
        kept = self._kept.get(key)
        return self._copy(key, values()) if kept is None else kept

    def _copy(self, key: Hashable, values: Tensor) -> Tensor:
        size = values.numel() * values.element_size()
        copy = sent(values, self.device)
        if self.used + size <= self.budget:
            self._kept[key] = copy
            self.used += size
        return copy


def _smallest(image: Tensor) -> Tensor:
    """Return values in [0, 1] as bytes if they are multiples of 1/255 to the bit, otherwise as they are."""
    numbers = (image * 255.0).round().to(torch.uint8)
    return numbers if torch.equal(numbers.float() / 255.0, image) else image
