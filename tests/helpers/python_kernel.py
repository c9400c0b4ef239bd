"""A Python function in the place of a compiled kernel."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import numpy as np

from scgs_warp.runtime.cpu_threads import Chunks


class PythonKernel:
    """What ``cpu_threads.share`` needs of a kernel: runs ``call(first, size)`` for every chunk."""

    def __init__(self, call: Callable[[int, int], None]) -> None:
        def entry(bounds: int, arguments: int) -> None:
            call(ctypes.c_int.from_address(arguments).value, ctypes.c_int64.from_address(bounds).value)

        self._entry = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(entry)
        self.address = ctypes.cast(self._entry, ctypes.c_void_p).value

    def bounds(self, size: int) -> bytes:
        return size.to_bytes(8, "little")


def single_chunks(count: int) -> Chunks:
    """Cut a grid into chunks of one index."""
    return Chunks(np.arange(count), np.ones(count, np.int64))
