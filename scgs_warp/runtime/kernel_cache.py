"""Warp's folder of compiled kernels: a private one takes its place if it cannot be used.

Warp keeps compiled kernels in the folder that ``WARP_CACHE_PATH`` names, by default in the user's cache folder. If the
disk is full, the compiler ends the process; if the folder belongs to somebody else, they could replace the machine code
that this process runs.
"""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from json import JSONDecodeError
from typing import TypeVar

import warp as wp

from ..errors import UserError
from . import addresses

LEAST_ROOM = 8 << 20
"""Free bytes needed to compile a kernel; the largest ones take a few megabytes."""
VARIABLE = "WARP_CACHE_PATH"
REMEDY = f"name a folder of yours with {LEAST_ROOM >> 20} MiB of room in {VARIABLE}"
NOT_LOADED = ("Failed to find", "Failed to load CPU module")
"""Beginnings of Warp's errors where the loader failed, or yielded code without a kernel."""

Result = TypeVar("Result")
_lock = threading.RLock()
_private: str | None = None


def initialise_warp(init: Callable[[], None]) -> None:
    """Initialise Warp, with a private folder for kernels if the usual one cannot be made or may not be trusted.

    Args:
        init: calls ``wp.init``.

    Raises:
        UserError: there is no place for a private folder either.
    """
    try:
        init()
    except OSError as error:
        _use_private(f"{error.filename}: {error.strerror}")
        init()
    folder = str(wp.config.kernel_cache_dir)
    distrust = None if _is_private(folder) else _distrust(folder)
    if distrust is not None:
        _use_private(f"{folder}: {distrust}")


def prepared(kernel: wp.Kernel, prepare: Callable[[], Result]) -> Result:
    """Return ``prepare()``, which compiles a kernel unless it is cached, in a folder that can be written.

    Raises:
        UserError: no folder can be written, or the compiled code cannot be loaded.
        NotEnoughMemory: the limit of addresses leaves no room for it.
    """
    addresses.require(addresses.KERNEL, "the code of a kernel")
    with _lock:
        folder = str(wp.config.kernel_cache_dir)
        if _room(folder) < LEAST_ROOM and not _is_compiled(kernel):
            _use_private(f"{folder}: no room")
        try:
            return prepare()
        except OSError as error:
            if _is_private(folder):
                raise UserError(f"{error.filename or folder}: {error.strerror}; {REMEDY}") from error
            _use_private(f"{folder}: {error.strerror}")
            return prepare()
        except Exception as error:  # Warp raises nothing more specific
            if not str(error).startswith(NOT_LOADED) and not isinstance(error, (JSONDecodeError, UnicodeDecodeError)):
                raise
            raise UserError(
                f"{folder}: the code of {kernel.key} is there but cannot be loaded; free memory (or raise ulimit -v), "
                "or remove the folder if its files are damaged"
            ) from error


def _use_private(reason: str) -> None:
    wp.config.kernel_cache_dir = _private_folder(reason)


def _private_folder(reason: str) -> str:
    """Return a folder that only this user can enter, which is removed when the process ends; report it once."""
    global _private
    if _private is None:
        try:
            folder = tempfile.mkdtemp(prefix="scgs-warp-kernels-")
            if _room(folder) < LEAST_ROOM:
                os.rmdir(folder)
                raise OSError(28, "no room")
        except OSError as error:
            message = f"kernels cannot be cached ({reason}), nor in {tempfile.gettempdir()} ({error.strerror})"
            raise UserError(f"{message}; {REMEDY}") from None
        _private = folder
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        with suppress(OSError):
            print(
                f"warning: kernels cannot be cached ({reason}) and are compiled for this process alone; {REMEDY}",
                file=sys.stderr,
                flush=True,
            )
    return _private


def _is_private(folder: str) -> bool:
    return _private is not None and folder.startswith(_private)


def _room(folder: str) -> int:
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return LEAST_ROOM  # Compiling reports what is wrong.


def _distrust(folder: str) -> str | None:
    """Return why a folder may not be trusted: it belongs to another user than this one or root, or all may write it."""
    if not hasattr(os, "geteuid"):
        return None
    facts = os.stat(folder)
    if facts.st_uid not in (0, os.geteuid()):
        return f"belongs to user {facts.st_uid}"
    return "every user may write there" if facts.st_mode & 0o002 else None


def _is_compiled(kernel: wp.Kernel) -> bool:
    """Return whether the cache holds the kernel's module."""
    try:
        names = {kernel.module.get_module_identifier(block) for block in (1, None)}  # on a CPU, on CUDA
    except Exception:  # The name is a detail of Warp's; without it the module counts as not compiled.
        return False
    return any(os.path.isdir(os.path.join(str(wp.config.kernel_cache_dir), name)) for name in names)
