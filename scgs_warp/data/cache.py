"""Cache of decoded images with a limit in bytes. Images that do not fit are decoded again at each access.

Training visits all frames in a new order every epoch, so cached images are never evicted: the least recently used image
is likely to be needed next. A run's results are bit-identical for every size of the cache.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from numbers import Real
from typing import NamedTuple

from torch import Tensor

from ..config.fields import CACHE_MIB
from ..errors import UserError
from ..runtime import addresses, memory

MEMORY_SHARE = 0.5
"""Largest share that the cache may take of the memory that is free at the start."""
READ_AHEAD = 2
"""Largest number of images decoded ahead of their use."""


class Pixels(NamedTuple):
    """Pixels of a decoded file, reduced and composited."""

    image: Tensor
    """[H, W, 3] float32, stored planar."""
    alpha: Tensor | None = None
    """[H, W] float32; None without alpha."""
    mask: Tensor | None = None
    """[H, W] bool, the frame's own mask, without the border of the video; None if every pixel is valid."""

    @property
    def bytes(self) -> int:
        return sum(tensor.numel() * tensor.element_size() for tensor in self if tensor is not None)


class ImageCache:
    """Cache shared by the splits of a run; safe to use from several threads."""

    def __init__(self, mib: float = CACHE_MIB) -> None:
        if not (isinstance(mib, Real) and 0 <= mib < math.inf):
            raise UserError(f"cache_mib is {mib!r:.80}; give a number of MiB, 0 or more")
        self.budget = min(int(mib * 2**20), int(MEMORY_SHARE * memory.room("cpu")))
        self.used = 0
        self._kept: dict[Hashable, Pixels] = {}
        self._coming: dict[Hashable, Future[Pixels]] = {}
        self._lock = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None

    def __contains__(self, key: Hashable) -> bool:
        return key in self._kept

    def get(self, key: Hashable, read: Callable[[], Pixels]) -> Pixels:
        """Return the cached pixels of ``key``, or read them and cache them if there is room.

        Raises:
            Any exception that ``read`` raises.
        """
        with self._lock:
            kept, coming = self._kept.get(key), self._coming.pop(key, None)
        if kept is not None:
            return kept
        pixels = read() if coming is None else coming.result()
        self.offer(key, pixels)
        return pixels

    def offer(self, key: Hashable, pixels: Pixels) -> None:
        """Cache pixels, if they fit."""
        size = pixels.bytes
        with self._lock:
            if key not in self._kept and self.used + size <= self.budget:
                self._kept[key] = pixels
                self.used += size

    @property
    def read_ahead(self) -> int:
        """Number of images that were requested in advance and not yet accessed."""
        return len(self._coming)

    def expect(self, key: Hashable, read: Callable[[], Pixels]) -> None:
        """Start to read an image in the background, before it is accessed, if there is room for a thread."""
        with self._lock:
            if key in self._kept or key in self._coming:
                return
            if self._pool is None:
                if not addresses.fits(addresses.THREAD):
                    return
                self._pool = ThreadPoolExecutor(1, "images")
            while len(self._coming) >= READ_AHEAD:  # The order has changed: drop the oldest.
                self._coming.pop(next(iter(self._coming))).cancel()
            self._coming[key] = self._pool.submit(read)

    def strip_alpha(self, key: Hashable) -> None:
        """Drop the alpha of the pixels cached under ``key``."""
        with self._lock:
            kept = self._kept.get(key)
            if kept is not None and kept.alpha is not None:
                self._kept[key] = bare = kept._replace(alpha=None)
                self.used -= kept.bytes - bare.bytes
