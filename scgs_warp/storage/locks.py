"""Locks on files, which the system releases when their process ends, however it ends."""

from __future__ import annotations

import os
from pathlib import Path


class AlreadyLocked(Exception):
    """Another process holds the lock."""


def lock_file(path: Path) -> int:
    """Create a file if it is missing, and lock it; return its descriptor, whose closing releases the lock.

    On file systems without locks, the descriptor is returned all the same.

    Raises:
        AlreadyLocked: another process holds the lock.
        OSError: the file cannot be created.
    """
    number = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        _lock(number)
    except BlockingIOError:
        os.close(number)
        raise AlreadyLocked(str(path)) from None
    except OSError:
        pass
    return number


def _lock(number: int) -> None:
    try:
        import fcntl
    except ImportError:  # Windows
        import msvcrt

        try:
            msvcrt.locking(number, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        except OSError:
            raise BlockingIOError from None
        return
    fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
