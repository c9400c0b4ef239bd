"""Decoded images in memory, up to a number of bytes; the rest is decoded again whenever it is asked for.

Training visits all frames in another order every epoch. What has found room therefore stays: pushing out the least
recently used would lose, each time, what is needed next. No bit of a run depends on what is kept.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

from torch import Tensor

from ..config.fields import CACHE_MIB
from ..runtime import memory

MEMORY_SHARE = 0.5
"""Part of the memory that is free at the start which images may take."""
READ_AHEAD = 2
"""Images that are decoded before they are asked for."""


class Pixels(NamedTuple):
    """What a file says, reduced and composited."""

    image: Tensor
    """[H, W, 3] float32, stored planar."""
    alpha: Tensor | None = None
    """[H, W] float32."""
    mask: Tensor | None = None
    """[H, W] bool, the frame's own; what the video masks in all frames comes on top."""

    @property
    def bytes(self) -> int:
        return sum(tensor.numel() * tensor.element_size() for tensor in self if tensor is not None)


class ImageCache:
    """Shared by the splits of a run, used by several threads."""

    def __init__(self, mib: float = CACHE_MIB) -> None:
        self.budget = min(int(mib * 2**20), int(MEMORY_SHARE * memory.room("cpu")))
        self.used = 0
        self._kept: dict[Hashable, Pixels] = {}
        self._coming: dict[Hashable, Future[Pixels]] = {}
        self._lock = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None

    def __contains__(self, key: Hashable) -> bool:
        return key in self._kept

    def get(self, key: Hashable, read: Callable[[], Pixels]) -> Pixels:
        """What is kept under ``key``, else what ``read`` returns, kept from now on if there is room.

        Raises:
            whatever ``read`` raises.
        """
        with self._lock:
            found, coming = self._kept.get(key), self._coming.pop(key, None)
        if found is not None:
            return found
        pixels = read() if coming is None else coming.result()
        self.offer(key, pixels)
        return pixels

    def offer(self, key: Hashable, pixels: Pixels) -> None:
        """Keep it if there is room."""
        size = pixels.bytes
        with self._lock:
            if key not in self._kept and self.used + size <= self.budget:
                self._kept[key] = pixels
                self.used += size

    @property
    def read_ahead(self) -> int:
        """Number of images that were begun in the background and not asked for yet."""
        return len(self._coming)

    def expect(self, key: Hashable, read: Callable[[], Pixels]) -> None:
        """Begin to read in the background what will be asked for soon."""
        with self._lock:
            if key in self._kept or key in self._coming:
                return
            if self._pool is None:
                self._pool = ThreadPoolExecutor(1, "images")
            while len(self._coming) >= READ_AHEAD:  # foretold wrongly: the order has changed
                self._coming.pop(next(iter(self._coming))).cancel()
            self._coming[key] = self._pool.submit(read)

    def strip_alpha(self, key: Hashable) -> None:
        """Forget the alpha of what is kept under ``key``."""
        with self._lock:
            found = self._kept.get(key)
            if found is not None and found.alpha is not None:
                self._kept[key] = bare = found._replace(alpha=None)
                self.used -= found.bytes - bare.bytes
