"""Independence of the settings that a caller of the library has changed for torch."""

from __future__ import annotations

import contextlib
import functools
import inspect
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import torch

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
Kind = TypeVar("Kind")

KINDS = ("cpu", "cuda")
"""Kinds of devices that may have autocast."""

_lock = threading.Lock()
_guests = 0
"""Number of calls under way that need float32 as default type, which is that of all threads."""
_callers_dtype = torch.float32
"""Default type before the first of them."""


def unaffected(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Let a function compute as if its caller had changed none of torch's settings: without autocast, with float32 and
    the CPU as defaults. ``torch.compile`` leaves the function as it is, since it cannot compile kernels, and would
    trace all that launches them instead."""
    eager: list[Callable[Parameters, Result]] = []

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        run = function
        if "torch._dynamo" in sys.modules:  # importing the compiler takes a second
            if not eager:
                untraced: Any = torch.compiler.disable(function)
                eager.append(untraced)
            run = eager[0]
        if _as_usual():
            return run(*args, **kwargs)
        with _usual_settings():
            return run(*args, **kwargs)

    return call


def unaffected_methods(kind: type[Kind]) -> type[Kind]:
    """Make all methods of a class, also those that it inherits, :func:`unaffected`."""
    for name in dir(kind):
        method = inspect.getattr_static(kind, name)
        if inspect.isfunction(method) and (name == "__init__" or not name.startswith("__")):
            setattr(kind, name, unaffected(method))
    return kind


def _as_usual() -> bool:
    with _lock:
        plain = not _guests and torch.get_default_dtype() is torch.float32
    return plain and torch.get_default_device().type == "cpu" and not any(map(torch.is_autocast_enabled, KINDS))


@contextlib.contextmanager
def _usual_settings() -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for kind in filter(torch.is_autocast_enabled, KINDS):
            stack.enter_context(torch.autocast(kind, enabled=False))
        stack.enter_context(torch.device("cpu"))
        stack.enter_context(_float32_by_default())
        yield


@contextlib.contextmanager
def _float32_by_default() -> Iterator[None]:
    """Make float32 the default type until the last of the calls that overlap has ended: a shorter call of another
    thread must not give the caller's type back meanwhile."""
    global _guests, _callers_dtype
    with _lock:
        if not _guests:
            _callers_dtype = torch.get_default_dtype()
            torch.set_default_dtype(torch.float32)
        _guests += 1
    try:
        yield
    finally:
        with _lock:
            _guests -= 1
            if not _guests:
                torch.set_default_dtype(_callers_dtype)
