"""Permission of the operating system to use the tile registers of AMX."""

from __future__ import annotations

import ctypes
import functools
import platform
import sys

ARCH_PRCTL = 158
"""Number of Linux' system call on x86-64."""
REQUEST_STATE, TILE_DATA = 0x1023, 18
"""Its arguments: ARCH_REQ_XCOMP_PERM, for the state of the tile registers."""


@functools.cache
def may_use_tiles() -> bool:
    """Ask Linux to let this process and its threads use the tile registers; return whether it does.

    Without permission, the first instruction that uses them would end the process.
    """
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return False
    try:
        return ctypes.CDLL(None).syscall(ARCH_PRCTL, REQUEST_STATE, TILE_DATA) == 0
    except (OSError, AttributeError):
        return False
