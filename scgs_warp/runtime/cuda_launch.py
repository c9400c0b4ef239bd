"""Recorded kernel launches on CUDA: repeating one costs little more than packing its arguments.

Warp records the launch of a kernel once. It reads the arguments from one block of memory, which later launches refill.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Sequence
from typing import Any

import torch
import warp as wp

from .kernel_arguments import FIRST_SIZE, ArgumentPacker, warp_arguments


class RecordedKernel:
    """A kernel prepared for repeated launches on one device with one block size."""

    def __init__(
        self,
        kernel: wp.Kernel,
        args: Sequence[Any],
        dim: int | tuple[int, int],
        device: torch.device,
        block_dim: int = 256,
    ) -> None:
        """
        Args:
            kernel: its first argument is ``first: int``.
            args: example arguments after ``first``, of the declared kinds; every launch passes its own.
            dim: dimensions of the grid.

        Raises:
            ValueError, TypeError: as :meth:`launch`.
        """
        self._command: Any = wp.launch(
            kernel,
            dim=dim,
            inputs=[0, *warp_arguments(kernel, args)],
            device=wp.device_from_torch(device),
            block_dim=block_dim,
            record_cmd=True,
        )
        self._dim = dim
        self._lock = threading.Lock()
        params, addresses = self._command.params, self._command.params_addr
        self._packer = ArgumentPacker(kernel, params[1:], device)
        self._buffer = (ctypes.c_uint64 * -(-self._packer.size // 8))()  # aligned for every kind of argument
        for index, offset in enumerate(self._packer.offsets, 1):
            params[index] = type(params[index]).from_buffer(self._buffer, offset)
            if addresses is not None:
                addresses[index] = ctypes.c_void_p(ctypes.addressof(params[index]))

    def launch(self, dim: int | tuple[int, int], args: Sequence[Any], stream: wp.Stream | None, begin: int = 0) -> None:
        """Run the kernel on ``stream`` with other arguments, from grid index ``begin`` on.

        Raises:
            ValueError: a tensor's dtype, shape, strides or device is not what the kernel declares.
            TypeError: the number or the kind of an argument is wrong.
        """
        block = begin.to_bytes(FIRST_SIZE, "little") + self._packer.pack(args)
        with self._lock:
            ctypes.memmove(self._buffer, block, len(block))
            if dim != self._dim:
                self._command.set_dim(dim)
                self._dim = dim
            self._command.launch(stream)
