"""Shared parts of the apps: device and threads, errors in one line, exit statuses."""

from __future__ import annotations

import functools
import gc
import math
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Literal

from scgs_warp.errors import UserError, is_shortage, one_line
from scgs_warp.runtime import environment
from scgs_warp.runtime.standard_streams import prepare_standard_streams
from scgs_warp.runtime.stop_signals import like_ctrl_c
from scgs_warp.runtime.torchrun import process_label

Device = Literal["auto", "cpu", "cuda"]
NO_WARP_GPU = (
    "torch finds a GPU, but Warp does not: its wheel on PyPI needs an NVIDIA driver of version 580 or newer; update "
    "the driver or install the wheel for CUDA 12 of the same version (+cu12) from github.com/NVIDIA/warp/releases"
)
"""Warp lists no device of a driver that is older than its CUDA version."""
MOST_THREADS = 1024
"""Largest number of threads: the libraries crash where the system refuses them more."""


def choose_device(device: Device) -> str:
    """Return the device; ``auto`` takes a GPU if torch and Warp find one, and says so if only torch does.

    Raises:
        UserError: ``cuda`` was asked for, and there is no GPU, or Warp does not find it.
    """
    import torch

    if device == "cpu" or not torch.cuda.is_available():
        if device == "cuda":
            raise UserError(
                "--device cuda: torch finds no CUDA GPU here; use --device cpu, or install a CUDA build of torch"
            )
        return "cpu"
    if not environment.warp_finds_gpu():
        if device == "cuda":
            raise UserError(f"--device cuda: {NO_WARP_GPU}, or use --device cpu")
        _tell(f"using the CPU: {NO_WARP_GPU}")
        return "cpu"
    return "cuda"


def _tell(text: str) -> None:
    with suppress(OSError):  # The terminal may be closed.
        print(text, file=sys.stderr, flush=True)


def _more_memory() -> str:
    """Return the remedy for a lack of memory."""
    try:
        import resource
    except ImportError:  # Windows
        limit = -1
    else:
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        limit = -1 if limit == resource.RLIM_INFINITY else limit
    if limit < 0:
        return "free some, or give less at once"
    return f"this process may use {limit >> 20} MiB of addresses (ulimit -v): allow more, or give less at once"


@functools.cache
def spare_libraries() -> None:
    """Take the objects of the libraries out of all later collections, once in a process: each would take 0.1 s."""
    gc.freeze()


def run(main: Callable[[list[str] | None], None], args: list[str] | None = None) -> int:
    """Run an app; a user's mistake gives one line on stderr and status 2; Ctrl-C, SIGTERM or the closing of the
    terminal status 130."""
    prepare_standard_streams()
    try:
        with like_ctrl_c():
            main(args)
    except UserError as error:
        _tell(f"error{process_label()}: {one_line(error)}")
        return 2
    except OSError as error:
        if isinstance(error, BrokenPipeError):  # The reader (head, a pager) has closed the pipe.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        _tell(f"error: {one_line(error)}")
        return 2
    except (MemoryError, RuntimeError, ImportError) as error:
        if not is_shortage(error):
            raise
        _tell(f"error{process_label()}: there is not enough memory for this; {_more_memory()}")
        return 2
    except KeyboardInterrupt:
        _tell("interrupted")
        return 130
    return 0


def print_parts(*parts: object, width: int | None = None) -> None:
    """Print tables and lines of rich, which itself would end the program with status 1 once the reader is gone.

    Args:
        width: number of columns; None: those of the terminal.
    """
    from rich.console import Console

    console = Console(width=width)
    with console.capture() as text:
        for part in parts:
            console.print(part)
    print(text.get(), end="", flush=True)


def prepare(device: Device, threads: int | None, memory_gib: float | None = None) -> str:
    """Configure threads, the flushing of denormals and the memory limit, then choose the device.

    Call it before the first tensor operation.
    """
    if threads is not None and threads < 1:
        raise UserError(f"--threads {threads}: must be at least 1")
    if threads is not None and threads > MOST_THREADS:
        raise UserError(f"--threads {threads}: give at most {MOST_THREADS:,}; more than the cores gain nothing")
    if memory_gib is not None and not 0.0 < memory_gib < math.inf:
        raise UserError(f"--memory-gib {memory_gib:g}: must be greater than 0")
    with environment.no_collection():
        environment.configure(threads)
    spare_libraries()
    if memory_gib is not None:
        from scgs_warp.runtime import memory

        memory.set_limit(memory_gib)
        os.environ[memory.LIMIT_VARIABLE] = str(memory_gib)  # Child processes read it.
    return choose_device(device)
