"""Independence of the settings that a caller of the library has changed for torch."""

from __future__ import annotations

import contextlib
import functools
import inspect
import sys
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import torch

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
Kind = TypeVar("Kind")

KINDS = ("cpu", "cuda")
"""Kinds of devices that may have autocast."""


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
    plain = torch.get_default_dtype() is torch.float32 and torch.get_default_device().type == "cpu"
    return plain and not any(map(torch.is_autocast_enabled, KINDS))


@contextlib.contextmanager
def _usual_settings() -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for kind in filter(torch.is_autocast_enabled, KINDS):
            stack.enter_context(torch.autocast(kind, enabled=False))
        stack.enter_context(torch.device("cpu"))
        stack.callback(torch.set_default_dtype, torch.get_default_dtype())
        torch.set_default_dtype(torch.float32)
        yield
