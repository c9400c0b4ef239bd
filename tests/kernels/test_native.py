"""Native headers: each compiles by itself without a warning, and an edited one is compiled again."""

from __future__ import annotations

import importlib
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import warp as wp

from scgs_warp.kernels import native
from scgs_warp.runtime.launch import launch

from helpers.clang import compiler  # isort: skip
from helpers.cuda_emulation import SHIM  # isort: skip

HEADERS = sorted(path.name for path in native.FOLDER.glob("*.h"))
WARNINGS = ["-Wall", "-Wextra", "-Werror", "-Wno-psabi", "-Wno-unused-function"]


def write_unit(path: Path, names: list[str], *more: str) -> list[str]:
    """Write a C++17 file that includes headers as Warp does; return the words of the command, to which the compiler's
    task is missing. For CUDA the emulation of a block stands in; it and Warp's own headers count as system headers."""
    constants = {k: v for name in names for k, v in native.constant_macros(native.header_text(name)).items()}
    if all(name.endswith("_cuda.h") for name in names):
        folder, prologue = SHIM.parent, [f"#include <{SHIM.name}>"]
    else:
        folder, prologue = Path(wp.__file__).parent / "native", ["#define WP_NO_CRT", '#include "builtin.h"']
    defined = [f"#define {k} {v}" for k, v in constants.items()]
    included = [f'#include "{native.FOLDER / name}"' for name in names]
    path.write_text("\n".join([*prologue, *defined, *included, *more, ""]), encoding="utf-8")
    return [compiler(), "-std=c++17", *WARNINGS, "-isystem", str(folder), str(path)]


@pytest.mark.parametrize("name", HEADERS)
def test_compiles_by_itself(name, tmp_path):
    command = [*write_unit(tmp_path / "unit.cpp", [name]), "-fsyntax-only"]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert result.returncode == 0, result.stderr[-4000:]


NETWORK = "network_block", "network_block_adjoint", "network_inputs_block_adjoint", "network_panel_adjoint"
NETWORK_PAIRS = "network_block_adjoint_pairs", "network_panel_adjoint_pairs"


def network_assembly(folder: Path, *target: str, functions: tuple[str, ...] = NETWORK) -> list[str]:
    """Return the lines of assembly of the network's kernels for a target, given as words for Clang."""
    kept = f"void* kept[] = {{{', '.join(f'(void*)&{name}' for name in functions)}}};"
    command = write_unit(folder / "unit.cpp", ["network.h", "network_adjoint.h", "network_pairs.h"], kept)
    command += [*target, "-O2", "-S", "-o", str(folder / "unit.s")]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert result.returncode == 0, result.stderr[-4000:]
    return (folder / "unit.s").read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize(("functions", "product"), [(NETWORK, "vfmadd"), (NETWORK_PAIRS, "vdpbf16ps")])
@pytest.mark.parametrize("processor", ["sapphirerapids", "znver4"])
def test_the_network_uses_whole_registers(processor, functions, product, tmp_path):
    """Where Clang tunes for an Intel CPU it cuts vectors of 512 bits into halves, at two thirds of the speed."""
    lines = network_assembly(tmp_path, "--target=x86_64-linux-gnu", f"-march={processor}", functions=functions)
    fused = [line for line in lines if product in line]
    assert len(fused) >= len(functions) * 16 and all("zmm" in line for line in fused)


def innermost_loops(lines: list[str]) -> list[list[str]]:
    """Return the loops of a function's assembly in which there is no other label."""
    loops, begin, label = [], 0, ""
    for index, line in enumerate(lines):
        if found := re.match(r"(\.L\w+):", line):
            begin, label = index, found[1]
        elif re.match(rf"\s+(j|b\.|cbn?z|tbn?z).*{re.escape(label)}$", line) and label:
            loops.append(lines[begin + 1 : index])
    return loops


@pytest.mark.parametrize(
    ("functions", "target", "product", "register", "tile"),
    [
        (NETWORK, ("--target=x86_64-linux-gnu", "-march=znver4"), "vfmadd", "zmm", 16),
        (NETWORK, ("--target=x86_64-linux-gnu", "-march=haswell"), "vfmadd", "ymm", 8),
        (NETWORK, ("--target=x86_64-linux-gnu", "-march=ivybridge"), "vmulps", "ymm", 8),
        (NETWORK, ("--target=aarch64-linux-gnu",), "fmla", "v", 16),
        (NETWORK_PAIRS, ("--target=x86_64-linux-gnu", "-march=znver4"), "vdpbf16ps", "zmm", 16),
        (NETWORK_PAIRS, ("--target=x86_64-linux-gnu", "-march=haswell"), "vfmadd", "ymm", 16),
        (NETWORK_PAIRS, ("--target=aarch64-linux-gnu",), "fmla", "v", 32),
    ],
    ids=["avx512", "avx2", "avx", "neon", "avx512-pairs", "avx2-pairs", "neon-pairs"],
)
def test_the_networks_sums_stay_in_registers(functions, target, product, register, tile, tmp_path):
    """No innermost loop that multiplies a whole tile moves a vector from or to the stack."""
    loops = innermost_loops(network_assembly(tmp_path, *target, functions=functions))
    products = [[line for line in loop if product in line] for loop in loops]
    tiles = [own and len(own) % tile == 0 and all(register in line for line in own) for own in products]
    whole = [loop for loop, fits in zip(loops, tiles) if fits]  # one tile, or some if the compiler unrolls the loop
    assert len(whole) >= len(functions)
    for loop in whole:
        on_stack = [line for line in loop if re.search(r"\(%r[sb]p|\[sp|\[x29", line)]
        assert not [line for line in on_stack if re.search(r"%[xyz]mm|\b[vqds]\d", line)]


def test_headers_include_only_their_neighbours():
    for name in HEADERS:
        text = native.header_text(name)
        assert "#include" not in text and "#pragma once" not in text, name


def test_every_header_is_formatted():
    formatter = shutil.which("clang-format") or str(Path(sys.executable).with_name("clang-format"))
    if not Path(formatter).is_file():
        pytest.skip("clang-format is not installed")
    paths = [str(native.FOLDER / name) for name in HEADERS]
    result = subprocess.run([formatter, "--dry-run", "--Werror", *paths], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]


KERNEL = """
import warp as wp
from scgs_warp.kernels.native import native_function

@native_function("scale.h", folder="{folder}")
def scale(i: int, values: wp.array[float]): ...

@wp.kernel
def scale_all(first: int, values: wp.array[float]):
    scale(first + wp.tid(), values)
"""
HEADER = "static inline void scale(int i, wp::array_t<float>& values) {{ values.data[i] *= {factor}; }}\n"


def test_an_edited_header_is_compiled_again(tmp_path, monkeypatch):
    """The kernel's own file stays as it is: only what the header includes changes."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "scale.h").write_text('#pragma once\n#include "factor.h"\n', encoding="utf-8")
    (tmp_path / "scaling_kernel.py").write_text(KERNEL.format(folder=tmp_path), encoding="utf-8")
    results = []
    for factor in ("2.0f", "3.0f", "2.0f"):
        (tmp_path / "factor.h").write_text(HEADER.format(factor=factor), encoding="utf-8")
        sys.modules.pop("scaling_kernel", None)
        module = importlib.import_module("scaling_kernel")
        values = torch.ones(3)
        launch(module.scale_all, 3, values)
        results.append(values.tolist())
    assert results == [[2.0] * 3, [3.0] * 3, [2.0] * 3]
