"""The native functions of ``kernels.cuda.compositing``, compiled for the CPU with ``cuda_shim.h``."""

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
from scgs_warp.kernels.cuda import compositing

SHIM = Path(__file__).resolve().parent / "cuda_shim.h"
COMPILER = shutil.which("g++") if sys.platform == "linux" else None
_TYPES = {wp.vec2: "wp::vec2", wp.vec3: "wp::vec3", wp.vec2i: "wp::vec2i", float: "float", int: "int"}
_TYPES.update({wp.float32: "float", wp.int32: "int"})
HEADER = "compositing_cuda.h"
FUNCTIONS = {
    "composite": compositing.composite_tile,
    "composite_adjoint": compositing.composite_tile_adjoint,
}


def source() -> str:
    """Return the header and, for each kernel, a C function of its name that runs blocks of threads.

    Its arguments: first block, number of blocks, seed, pointers and shapes of the arrays, numbers.
    """
    text = native.header_text(HEADER)
    macros = [f"#define {name} {value}\n" for name, value in native.constant_macros(text).items()]
    parts = [f'#include "{SHIM}"\n', *macros, text]
    for name, function in FUNCTIONS.items():
        parameters, values, arrays, numbers = ["int tile"], ["tile"], 0, 0
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
            f"    {function.key}({', '.join(function.input_types)});\n}}\n"
        )
        parts.append(
            f'extern "C" int {name}(int begin, int blocks, unsigned seed,\n'
            f"    void** data, wp::Shape* shapes, double* numbers) {{\n"
            f"    std::mt19937 random(seed);\n"
            f"    for (int tile = begin; tile < begin + blocks; ++tile)\n"
            f"        if (!shim::run_block([=] {{ {name}_body({', '.join(values)}); }}, random)) return 1;\n"
            f"    return 0;\n}}\n"
        )
    return "".join(parts)


def build(folder: Path) -> ctypes.CDLL:
    assert COMPILER is not None
    code, library = folder / "bodies.cpp", folder / "bodies.so"
    code.write_text(source(), encoding="utf-8")
    flags = ["-O2", "-std=c++17", "-shared", "-fPIC", "-Wno-unknown-pragmas", "-Wno-cpp"]
    result = subprocess.run(
        [COMPILER, *flags, str(code), "-o", str(library)], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr[-4000:]
    return ctypes.CDLL(str(library))


def launcher(library: ctypes.CDLL, seed: int = 0) -> Callable[..., None]:
    """Return a function that takes the place of ``ops.compositing_cuda.launch_native``."""

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
