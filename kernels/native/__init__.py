"""C++ bodies of kernels: headers in this folder that become Warp functions.

A header holds ``static inline`` functions, structures and enumerations. Warp compiles a native function from a text
that becomes the function's body. :func:`native_function` makes this text: it puts a header and its includes into a
local structure and calls the function of the same name. Three rules follow:

- Write results to arrays: functions made in this way cannot declare a return type to Warp.
- Use no templates and no static data members, which local structures may not have. Use generic lambdas inside
  functions, functions that return generic lambdas, and functions or enumerations for constants.
- Include other headers of this folder with ``#include "name.h"`` alone on a line.

Warp hashes the text, so it compiles an edited header again. ``CONSTANTS`` holds the constants that Python and C++
share; they reach a header as macros. ``tests/kernels/test_native.py`` compiles every header by itself.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import warp as wp

from .. import binning, correctives, harmonics, neighbors, posing, projection, shading, silhouette, ssim, types

FOLDER = Path(__file__).parent
CONSTANTS: dict[str, int | float] = {
    "ADAM_CHUNK": types.ADAM_CHUNK,
    "ADAM_GRADIENT_MAX": types.ADAM_GRADIENT_MAX,
    "ALPHA_MAX": types.ALPHA_MAX,
    "CHANNEL_GROUP": types.CHANNEL_GROUP,
    "CHANNEL_MAX": types.CHANNEL_MAX,
    "NETWORK_ADJOINT_ROWS": types.NETWORK_ADJOINT_ROWS,
    "NETWORK_BLOCK": types.NETWORK_BLOCK,
    "NETWORK_PANEL": types.NETWORK_PANEL,
    "PACKED_GEOMETRY": types.PACKED_GEOMETRY,
    "ROOFLINE_BLOCK": types.ROOFLINE_BLOCK,
    "ROOFLINE_CHAINS": types.ROOFLINE_CHAINS,
    **{f"SH_{name}": getattr(harmonics, name) for name in harmonics.FACTORS},
    "SHARED_ARGUMENTS": types.SHARED_ARGUMENTS,
    "SSIM_BAND": types.SSIM_BAND,
    "SSIM_BLOCK": types.SSIM_BLOCK,
    "SSIM_C1": ssim.SSIM_C1,
    "SSIM_C2": ssim.SSIM_C2,
    "SSIM_LEAST_ERROR": ssim.LEAST_ERROR,
    **{f"SSIM_TAP_{distance}": tap for distance, tap in enumerate(ssim.TAPS)},
    "SSIM_TILE_COLUMNS": types.SSIM_TILE_COLUMNS,
    "SSIM_TILE_ROWS": types.SSIM_TILE_ROWS,
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
    # Correctives, shading, finishing and posing.
    "CORRECTIVE_SCALE": correctives.SCALE,
    "EXTRAS_LOG_SCALES": posing.LOG_SCALES,
    "EXTRAS_TINTS": posing.TINTS,
    "SHADING_BEND": shading.BEND,
    "SHADING_GAIN_MAX": shading.GAIN_MAX,
    "SHADING_GREY": shading.GREY,
    "SHADING_TINT_MAX": shading.TINT_MAX,
    "SHADING_TINT_MIN": shading.TINT_MIN,
    # Silhouettes.
    "SILHOUETTE_NEAREST_DEPTH": silhouette.NEAREST_DEPTH,
}
"""Values of the shared macros by name; a header gets those that occur in its text."""

_INCLUDE = re.compile(r'^#include "([\w./]+)"\n', re.MULTILINE)
_WORD = re.compile(r"\w+")
_GUARDS = {"cpu": "#if !defined(__CUDA_ARCH__)", "cuda": "#if defined(__CUDA_ARCH__)"}


def header_text(name: str, folder: Path = FOLDER) -> str:
    """Return the text of a header of ``folder``, with each included header in place of its first ``#include``."""
    seen: set[str] = set()

    def read(file: str) -> str:
        if file in seen:
            return ""
        seen.add(file)
        text = (folder / file).read_text(encoding="utf-8").replace("#pragma once\n", "")
        return _INCLUDE.sub(lambda match: read(match[1]), text)

    return read(name)


def constant_macros(text: str) -> dict[str, str]:
    """Return the shared constants that occur in ``text``, as macro names and C++ literals."""
    words = set(_WORD.findall(text))
    return {
        name: f"{value!r}f" if isinstance(value, float) else str(int(value))
        for name, value in CONSTANTS.items()
        if name in words
    }


def snippet(header: str, call: str, device: Literal["cpu", "cuda"], folder: Path = FOLDER) -> str:
    """Return the body of a native function that runs ``call``, a call to a function of ``header``.

    Args:
        device: device for which the header is compiled; for the other device the body is empty.
    """
    text = header_text(header, folder)
    macros = constant_macros(text)
    lines = [
        _GUARDS[device],
        *(f"#define {name} {value}" for name, value in macros.items()),
        f"struct native {{\n{text}}};",
        call,
        *(f"#undef {name}" for name in macros),
        "#endif",
    ]
    return "\n" + "\n".join(lines) + "\n"


def native_function(
    header: str, *, device: Literal["cpu", "cuda"] = "cpu", folder: str | Path = FOLDER
) -> Callable[[Callable[..., Any]], wp.Function]:
    """Make a Warp function whose body is the function of the same name in ``header``.

    Args:
        header: file name in ``folder``.
        device: device on which the function runs; on the other device it compiles but does nothing.
    """

    def decorate(function: Callable[..., Any]) -> wp.Function:
        name, arguments = function.__name__.lstrip("_"), ", ".join(inspect.signature(function).parameters)
        call = f"native::{name}({arguments});"
        return wp.func_native(snippet(header, call, device, Path(folder)))(function)

    return decorate
