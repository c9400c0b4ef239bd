"""The native functions of ``kernels.cuda``, compiled for the CPU with ``cuda_shim.h``."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import warp as wp

from scgs_warp.kernels import native
from scgs_warp.kernels.cuda import compositing, harmonics, neighbors, ssim

SHIM = Path(__file__).resolve().parent / "cuda_shim.h"
COMPILER = shutil.which("g++") if sys.platform == "linux" else None
_TYPES = {wp.vec2: "wp::vec2", wp.vec3: "wp::vec3", wp.vec2i: "wp::vec2i", float: "float", int: "int"}
_TYPES.update({wp.float32: "float", wp.float64: "double", wp.int32: "int", bool: "bool", wp.bool: "bool"})
FUNCTIONS = {
    "compositing_cuda.h": {
        "composite": compositing.composite_tile,
        "composite_adjoint": compositing.composite_tile_adjoint,
    },
    "harmonics_cuda.h": {
        "spherical_harmonics": harmonics.harmonics_of_block,
        "channels_with_depth": harmonics.channels_of_block,
        "spherical_harmonics_adjoint": harmonics.harmonics_of_block_adjoint,
    },
    "neighbors_cuda.h": {"nearest": neighbors.nearest_of_block},
    "ssim_cuda.h": {
        "photometric": ssim.photometric_tile,
        "photometric_total": ssim.sum_photometric,
        "photometric_adjoint": ssim.photometric_tile_adjoint,
    },
}
"""Native functions by header and by the kernel that calls them."""


def source() -> str:
    """Return the headers and, for each kernel, a C function of its name that runs blocks of threads."""
    return f'#include "{SHIM}"\n' + "".join(_unit(header, functions) for header, functions in FUNCTIONS.items())


def _unit(header: str, functions: dict[str, wp.Function]) -> str:
    """Return a header in a namespace of its own and the C functions of its kernels.

    Their arguments: first block, number of blocks, seed, pointers and shapes of the arrays, numbers.
    """
    text = native.header_text(header)
    space = header.removesuffix(".h")
    macros = native.constant_macros(text)
    parts = [f"#define {name} {value}\n" for name, value in macros.items()]
    parts += [f"namespace {space} {{\n{text}}}\n", *(f"#undef {name}\n" for name in macros)]
    for name, function in functions.items():
        parameters, values, arrays, numbers = ["int block"], ["block"], 0, 0
        for label, kind in list(function.input_types.items())[1:]:
            if wp.types.is_array(kind):
                inner = _TYPES[kind.dtype]
                parameters.append(f"wp::array_t<{inner}> {label}")
                values.append(f"wp::array_t<{inner}>{{({inner}*)data[{arrays}], shapes[{arrays}]}}")
                arrays += 1
            else:
                parameters.append(f"{_TYPES[kind]} {label}")
                values.append(f"({_TYPES[kind]})numbers[{numbers}]")
                numbers += 1
        parts.append(
            f"static void {name}_body({', '.join(parameters)}) {{\n"
            f"    {space}::{function.key}({', '.join(['block', *list(function.input_types)[1:]])});\n}}\n"
        )
        parts.append(
            f'extern "C" int {name}(int begin, int blocks, unsigned seed,\n'
            f"    void** data, wp::Shape* shapes, double* numbers) {{\n"
            f"    std::mt19937 random(seed);\n"
            f"    for (int block = begin; block < begin + blocks; ++block)\n"
            f"        if (!shim::run_block([=] {{ {name}_body({', '.join(values)}); }}, random)) return 1;\n"
            f"    return 0;\n}}\n"
        )
    return "".join(parts)


def build(folder: Path) -> ctypes.CDLL:
    assert COMPILER is not None
    code, library = folder / "bodies.cpp", folder / "bodies.so"
    code.write_text(source(), encoding="utf-8")
    flags = ["-O2", "-std=c++17", "-shared", "-fPIC", "-Wno-unknown-pragmas", "-Wno-cpp"]
    # Ubuntu's compiler fortifies by default, and a fortified longjmp refuses to enter the stack of another fibre.
    flags += ["-U_FORTIFY_SOURCE"]
    result = subprocess.run(
        [COMPILER, *flags, str(code), "-o", str(library)], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr[-4000:]
    return ctypes.CDLL(str(library))


def launcher(library: ctypes.CDLL, seed: int = 0) -> Callable[..., None]:
    """Return a function that takes the place of ``ops.cuda_blocks.launch_native``."""

    def launch_native(kernel: wp.Kernel, blocks: int, *args: Any, begin: int = 0) -> None:
        declared = [argument.type for argument in kernel.adj.args[1:]]
        arrays = [value for kind, value in zip(declared, args, strict=True) if wp.types.is_array(kind)]
        numbers = [value for kind, value in zip(declared, args) if not wp.types.is_array(kind)]
        data = (ctypes.c_void_p * len(arrays))()
        shapes = (ctypes.c_int * 4 * len(arrays))()
        for at, tensor in enumerate(arrays):
            if isinstance(tensor, torch.Tensor):
                assert tensor.is_contiguous()
                data[at] = tensor.data_ptr()
                shapes[at][: tensor.ndim] = list(tensor.shape)
        doubles = (ctypes.c_double * len(numbers))(*numbers)
        assert getattr(library, kernel.key)(begin, blocks, seed, data, shapes, doubles) == 0, "threads wait for ever"

    return launch_native
