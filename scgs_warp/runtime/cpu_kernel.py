"""Kernels prepared for the CPU."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from typing import Any

import torch
import warp as wp

from .kernel_arguments import ArgumentPacker, warp_arguments

CPU = torch.device("cpu")


class CpuKernel:
    """A kernel prepared for the CPU: its compiled entry point, and the packer of its arguments."""

    def __init__(self, kernel: wp.Kernel, args: tuple) -> None:
        self.kernel = kernel
        inputs = [0, *warp_arguments(kernel, args)]
        self._command: Any = wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True)  # compiles it
        self._entry = self._command.hooks.forward
        params = self._command.params
        self.address: int = ctypes.cast(self._entry, ctypes.c_void_p).value or 0
        """Address of the entry point, a C function of the launch bounds and the arguments."""
        self.bounds = functools.lru_cache(maxsize=4096)(lambda size: bytes(type(params[0])((size,))))
        """Function: launch bounds of a grid of this size."""
        self.pack = ArgumentPacker(kernel, params[1:], CPU).pack

    def __call__(self, args: tuple, begin: int, size: int) -> None:
        """Run a part of the grid in this thread; ``args`` are those after ``first``."""
        self._entry(self.bounds(size), begin.to_bytes(4, "little") + self.pack(args))

    def bound(self, args: tuple) -> Callable[[], None]:
        """Return a function that runs a grid of one index with these arguments, packed once. It keeps the kernel's code
        loaded; the caller keeps the tensors alive."""
        bounds, words = self.bounds(1), (0).to_bytes(4, "little") + self.pack(args)

        def run() -> None:
            self._entry(bounds, words)

        return run
