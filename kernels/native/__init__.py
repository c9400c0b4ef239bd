"""C++ bodies of kernels: the headers of this folder, spliced into Warp's functions.

A header holds ``static inline`` functions, structures and enumerations. Warp compiles a native function from a piece of
text that becomes the function's body, so :func:`native_function` puts a header, with what it includes, into a local
structure there and calls the function of the same name. Two rules follow for headers:

- no templates and no static data members, which local structures may not have: use generic lambdas inside a function,
  and functions or enumerations for constants;
- include other headers of this folder with ``#include "name.h"`` alone on a line.

Warp hashes the text it is given: an edited header is compiled again. Constants that Python and C++ share stand in
``CONSTANTS`` and reach a header as macros. ``tests/kernels/test_native.py`` compiles every header by itself.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import warp as wp

from .. import binning, neighbors, projection, types

FOLDER = Path(__file__).parent
CONSTANTS: dict[str, int | float] = {
    "ALPHA_MAX": types.ALPHA_MAX,
    "CHANNEL_GROUP": types.CHANNEL_GROUP,
    "PACKED_GEOMETRY": types.PACKED_GEOMETRY,
    "TRANSMITTANCE_MIN": types.TRANSMITTANCE_MIN,
    "LN_2": 1.0 / types.LOG2_E,
    "LOG2_E": types.LOG2_E,
    # Binning.
    "ALPHA_MIN": types.ALPHA_MIN,
    "REACH_SLACK": binning.REACH_SLACK,
    **{f"LOG2_{power}": value for power, value in enumerate(binning.LOG2_COEFFICIENTS)},
    # Neighbours.
    "MAX_DIMENSIONS": types.MAX_DIMENSIONS,
    "MAX_HYPER": types.MAX_HYPER,
    "MAX_NEIGHBORS": neighbors.MAX_NEIGHBORS,
    # Projection and skinning.
    "FRUSTUM_MARGIN": projection.FRUSTUM_MARGIN,
    "GRADIENT_MAX": types.GRADIENT_MAX,
    "POSITION_MAX": types.POSITION_MAX,
    "RADIUS_MAX": projection.RADIUS_MAX,
}
"""Macros by name; a header sees those that its text names."""

_INCLUDE = re.compile(r'^#include "([\w./]+)"\n', re.MULTILINE)
_GUARDS = {"cpu": "#if !defined(__CUDA_ARCH__)", "cuda": "#if defined(__CUDA_ARCH__)"}


def header_text(name: str, folder: Path = FOLDER) -> str:
    """Return a header of ``folder`` with every header it includes in place of its first ``#include``."""
    seen: set[str] = set()

    def read(file: str) -> str:
        if file in seen:
            return ""
        seen.add(file)
        text = (folder / file).read_text(encoding="utf-8").replace("#pragma once\n", "")
        return _INCLUDE.sub(lambda match: read(match[1]), text)

    return read(name)


def constant_macros(text: str) -> dict[str, str]:
    """Return the shared constants that ``text`` names, as macro names and C++ literals."""
    return {
        name: f"{value!r}f" if isinstance(value, float) else str(int(value))
        for name, value in CONSTANTS.items()
        if re.search(rf"\b{name}\b", text)
    }


def snippet(header: str, call: str, device: Literal["cpu", "cuda"], otherwise: str = "", folder: Path = FOLDER) -> str:
    """Return the body of a native function that runs ``call``, a call of a function of ``header``.

    Args:
        device: where the header compiles; for the other device the body is ``otherwise``.
    """
    text = header_text(header, folder)
    macros = constant_macros(text)
    lines = [
        _GUARDS[device],
        *(f"#define {name} {value}" for name, value in macros.items()),
        f"struct native {{\n{text}}};",
        call,
        *(f"#undef {name}" for name in macros),
        *(["#else", otherwise] if otherwise else []),
        "#endif",
    ]
    return "\n" + "\n".join(lines) + "\n"


def native_function(
    header: str, *, device: Literal["cpu", "cuda"] = "cpu", otherwise: str = "", folder: str | Path = FOLDER
) -> Callable[[Callable[..., Any]], wp.Function]:
    """Make a Warp function whose body is the function of the same name in ``header``.

    Args:
        header: file name in ``folder``.
        device: where the function runs; a kernel that calls it compiles for the other device, but does nothing there.
        otherwise: statement for the other device, needed where a value is returned.
    """

    def decorate(function: Callable[..., Any]) -> wp.Function:
        signature = inspect.signature(function)
        call = f"native::{function.__name__.lstrip('_')}({', '.join(signature.parameters)});"
        if signature.return_annotation is not inspect.Signature.empty:
            call = f"return {call}"
        return wp.func_native(snippet(header, call, device, otherwise, Path(folder)))(function)

    return decorate
