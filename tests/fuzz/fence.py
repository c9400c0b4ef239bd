"""Guard pages: inside :func:`fenced` every array given to a CPU kernel ends (or begins) at an inaccessible page, so
that an access out of bounds ends the process at once.

The bytes between an array and the guard page (less than a cache line, as kernels may rely on torch's alignment) are
filled with ones, which read as NaN or -1, and checked afterwards. Arrays that a kernel calls ``*_in``
must come back as they were.
"""

from __future__ import annotations

import ctypes
import mmap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from scgs_warp.runtime import launch
from scgs_warp.runtime.kernel_arguments import parameters_of

PAGE = mmap.PAGESIZE
ROOM = 1 << 23
"""Bytes of the largest array that is fenced; larger ones stay in place."""
LINE = 64


class OutOfBounds(AssertionError):
    """A kernel wrote outside its arrays."""


class _Region:
    """Pages between two guard pages."""

    def __init__(self) -> None:
        self.memory = mmap.mmap(-1, ROOM + 2 * PAGE)
        self.base = ctypes.addressof(ctypes.c_char.from_buffer(self.memory))
        libc = ctypes.CDLL(None, use_errno=True)
        for wall in (self.base, self.base + PAGE + ROOM):
            if libc.mprotect(ctypes.c_void_p(wall), ctypes.c_size_t(PAGE), 0):
                raise OSError(ctypes.get_errno(), "mprotect")

    def put(self, tensor: Tensor, high: bool) -> tuple[Tensor, int, int]:
        """Return a copy of the tensor beside a guard page, and the range of the bytes between them."""
        size = tensor.numel() * tensor.element_size()
        begin = PAGE + (ROOM - -(-size // LINE) * LINE if high else 0)
        rest = PAGE + ROOM if high else begin + -(-size // LINE) * LINE
        ctypes.memset(self.base + begin + size, 0xFF, rest - begin - size)
        kind = tensor.dtype
        copy = torch.frombuffer(self.memory, dtype=kind, count=tensor.numel(), offset=begin).view(tensor.shape)
        copy.copy_(tensor)
        return copy, begin + size, rest


class Fence:
    """Regions for the arrays of one launch after another."""

    def __init__(self) -> None:
        self.regions: list[_Region] = []
        self.held: list[tuple[int, int]] = []
        self.high = True
        self.launches = 0

    def _region(self, place: int) -> _Region:
        while len(self.regions) <= place:
            self.regions.append(_Region())
        return self.regions[place]

    def hold(self, tensor: Tensor) -> Tensor:
        """Return a copy beside a guard page, valid until :meth:`release`: for tensors passed by address."""
        size = tensor.numel() * tensor.element_size()
        if not 0 < size <= ROOM:
            return tensor.detach().clone()
        copy, begin, end = self._region(len(self.held)).put(tensor.detach(), self.high)
        self.held.append((begin, end))
        return copy

    def release(self) -> None:
        """Release the held copies."""
        held, self.held = self.held, []
        for place, (begin, end) in enumerate(held):
            if bytes(self.regions[place].memory[begin:end]) != b"\xff" * (end - begin):
                raise OutOfBounds("a kernel writes past the end of a tensor that it was given by address")

    def run(self, kernel: Any, parameters: list, args: tuple, go: Callable[[tuple], None]) -> None:
        """Call ``go`` with fenced copies of the tensors among ``args`` and copy its results back."""
        self.launches += 1
        moved: dict[tuple, tuple] = {}
        fenced = list(args)
        labels: dict[tuple, list[str]] = {}
        for place, (parameter, value) in enumerate(zip(parameters, args)):
            if not isinstance(value, Tensor) or not 0 < value.numel() * value.element_size() <= ROOM:
                continue
            key = (value.data_ptr(), value.numel(), value.dtype)
            if key not in moved:
                region = self._region(len(self.held) + len(moved))
                moved[key] = (region, value, *region.put(value, self.high))
            fenced[place] = moved[key][2].view(value.shape)
            labels.setdefault(key, []).append(parameter.label if parameter else "")
        go(tuple(fenced))
        for key, (region, value, copy, begin, end) in moved.items():
            names = labels[key]
            if bytes(region.memory[begin:end]) != b"\xff" * (end - begin):
                raise OutOfBounds(f"kernel {kernel.key} writes past the end of {names}")
            flat = value.as_strided((value.numel(),), (1,))  # contiguous, but strides of single rows may be anything
            if not torch.equal(flat.view(torch.uint8), copy.view(-1).view(torch.uint8)):
                if all(name.endswith("_in") for name in names):
                    raise OutOfBounds(f"kernel {kernel.key} writes to its input {names}")
                flat.copy_(copy.view(-1))


current: Fence | None = None
"""Return the active fence, for launches that do not go through ``runtime.launch``."""


def walled(tensor: Tensor) -> Tensor:
    """Return the detached tensor, beside a guard page where a fence is active and it is on a CPU."""
    if current is None or tensor.device.type != "cpu":
        return tensor.detach().clone()
    return current.hold(tensor)


@contextmanager
def fenced() -> Iterator[Fence]:
    """Fence launches on the CPU; the thread count must be 1."""
    global current
    fence, kernels = Fence(), launch.CpuKernel
    call = kernels.__call__

    def guarded(self: Any, args: tuple, begin: int, size: int) -> None:
        fence.run(self.kernel, parameters_of(self.kernel), args, lambda moved: call(self, moved, begin, size))

    kernels.__call__, current = guarded, fence  # type: ignore[method-assign]
    try:
        yield fence
    finally:
        kernels.__call__, current = call, None  # type: ignore[method-assign]
