"""Limit of a process's addresses (``ulimit -v``, batch systems): what it leaves, and what may begin in that.

A large allocation that fails raises an error. When the last few megabytes are gone, however, a new thread of Python may
die before it reports that it runs, and its starter waits for it forever; libraries end the process, and so does the
system when the stack cannot grow. Programs, threads and kernels therefore begin only where there is room for them.
"""

from __future__ import annotations

import contextlib
import ctypes
import threading

from .memory import NotEnoughMemory, hand_back, status

PROGRAM = 64 << 20
"""Free bytes that a program needs when its libraries are loaded."""
THREAD = 32 << 20
"""Free bytes that a thread needs: a stack of 8 MiB, as is usual, and some to work with."""
KERNEL = 2 << 20
"""Free bytes that loading a compiled kernel needs."""
STACK_LEVELS = 300
"""Depth of calls through C that takes about 600 KiB of stack; a training step takes up to 400 KiB."""


def limit() -> int | None:
    """Return the number of bytes that the process may address; None without a limit."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[0]
        return None if most == resource.RLIM_INFINITY else most
    return None


def fits(need: int) -> bool:
    """Return whether the limit leaves ``need`` bytes, after freed memory is handed back if it must be."""
    most = limit()
    return most is None or _left(most, need) >= need


def _left(most: int, need: int) -> int:
    left = most - (status("VmSize") or 0)
    if left < need:
        hand_back()
        left = most - (status("VmSize") or 0)
    return left


def require(need: int, what: str) -> None:
    """Refuse what does not fit.

    Args:
        need: bytes.
        what: begins the message.

    Raises:
        NotEnoughMemory: with the figures.
    """
    most = limit()
    if most is None:
        return
    free = _left(most, need)
    if free < need:
        raise NotEnoughMemory(
            f"{what} needs {need >> 20} MiB of addresses, and {max(0, free) >> 20} MiB are left of the "
            f"{most >> 20} MiB that this process may use (ulimit -v): allow more"
        )


def start(thread: threading.Thread) -> None:
    """Start a thread.

    Raises:
        NotEnoughMemory: there is no room for it, or the system starts no more.
    """
    require(THREAD, f"the thread {thread.name!r}")
    try:
        thread.start()
    except RuntimeError as error:
        raise NotEnoughMemory(f"the thread {thread.name!r} cannot be started: {error}; free memory") from error


def prepare() -> None:
    """Prepare a process for a limit of addresses; without a limit nothing is changed.

    Raises:
        NotEnoughMemory: the limit leaves too little to work with.
    """
    if limit() is None:
        return
    require(PROGRAM, "a program")
    _share_heap()
    _grow_stack(STACK_LEVELS)


def _share_heap() -> None:
    """Make glibc's threads share one heap; each would reserve up to 128 MiB of addresses for its own."""
    most_heaps = -8
    with contextlib.suppress(OSError, AttributeError, TypeError):  # not glibc
        ctypes.CDLL(None).mallopt(most_heaps, 1)


def _grow_stack(levels: int) -> None:
    """Let the main thread's stack grow beyond the needs of kernels, and keep what it has grown to.

    The system adds pages to it when they are first touched; where it may not, the process ends with SIGSEGV.
    """
    kind = ctypes.CFUNCTYPE(None, ctypes.c_int)

    def step(left: int) -> None:
        with contextlib.suppress(RecursionError, MemoryError):
            if left:
                call(left - 1)

    call = kind(step)
    call(levels)
