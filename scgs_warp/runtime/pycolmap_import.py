"""Import of pycolmap, whose library would otherwise answer SIGTERM with the stack of its C++ code."""

from __future__ import annotations

import ctypes
import importlib
import signal
import sys
import threading
from typing import Any

_lock = threading.Lock()


def import_pycolmap() -> Any:
    """Import pycolmap and keep the handler of SIGTERM, also in a thread, where ``signal.signal`` is not allowed."""
    with _lock:
        if "pycolmap" in sys.modules:
            return importlib.import_module("pycolmap")  # waits where another thread is importing it
        get, put = ctypes.pythonapi.PyOS_getsig, ctypes.pythonapi.PyOS_setsig
        get.restype = put.restype = ctypes.c_void_p
        get.argtypes, put.argtypes = [ctypes.c_int], [ctypes.c_int, ctypes.c_void_p]
        handler = get(signal.SIGTERM)
        try:
            return importlib.import_module("pycolmap")
        finally:
            put(signal.SIGTERM, handler)
