"""Cases that must fail, each in another way: they show that a campaign detects failures."""

from __future__ import annotations

import os
import signal
import time

import torch
import warp as wp

from fuzz.poison import Draw
from scgs_warp.runtime.launch import launch

from . import laws

wp.set_module_options({"enable_backward": False})


@wp.func_native("#if !defined(__CUDA_ARCH__)\n    values.data[i + offset] = 1.0f;\n#endif\n")
def _write(i: int, offset: int, values: wp.array[float]): ...


@wp.func_native("#if !defined(__CUDA_ARCH__)\n    return values.data[i + offset];\n#else\n    return 0.0f;\n#endif\n")
def _read(i: int, offset: int, values: wp.array[float]) -> float: ...


@wp.kernel
def write_beyond(first: int, offset: int, values_out: wp.array[float]):
    _write(first + wp.tid(), offset, values_out)


@wp.kernel
def read_beyond(first: int, offset: int, values_in: wp.array[float], values_out: wp.array[float]):
    i = first + wp.tid()
    values_out[i] = _read(i, offset, values_in)


@wp.kernel
def write_input(first: int, values_in: wp.array[float]):
    values_in[first + wp.tid()] = 2.0


def case_read(d: Draw, device: str) -> None:
    """Write beyond the array, on the fenced side."""
    launch(read_beyond, 16, 16 if d.seed % 2 == 0 else -16, torch.ones(16), torch.empty(16))


def case_write(d: Draw, device: str) -> None:
    """Write one element too many, in the same cache line."""
    launch(write_beyond, 17, 0, torch.ones(17)[:17])
    launch(write_beyond, 17, 1, torch.ones(17))


def case_input(d: Draw, device: str) -> None:
    launch(write_input, 4, torch.zeros(4))


def case_unwritten(d: Draw, device: str) -> None:
    laws.finite("values", torch.empty(5))


def case_abort(d: Draw, device: str) -> None:
    os.kill(os.getpid(), signal.SIGABRT)


def case_hang(d: Draw, device: str) -> None:
    time.sleep(60.0)


def case_fine(d: Draw, device: str) -> None:
    laws.finite("values", d.normal(5))


# Compiled before there is anything to be in time for.
launch(write_beyond, 1, 0, torch.ones(1))
launch(read_beyond, 1, 0, torch.ones(1), torch.ones(1))
launch(write_input, 1, torch.ones(1))

CASES = {
    "read": (case_read, 0.15),
    "write": (case_write, 1),
    "input": (case_input, 1),
    "unwritten": (case_unwritten, 1),
    "abort": (case_abort, 0.15),
    "hang": (case_hang, 0.15),
    "fine": (case_fine, 1),
}
