"""Write what every CUDA kernel takes of a GPU, without having one: registers, stack, memory, occupancy, instructions.

    pip install nvidia-cuda-nvdisasm
    python benchmarks/kernel_table.py --json benchmarks/results/kernels-cuda.json [--nvcc nvcc]

Warp compiles all kernels for sm_75, sm_90 and sm_120. Registers, stack and memory stand in the cubins; instructions are
counted in the disassembly for sm_90. With ``--nvcc`` the compositing kernels of the installed gsplat are compiled and
counted in the same way. ``benchmarks/report.py`` writes the tables of docs/benchmarks.md from the result.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cubins
import gsplat_kernels
import sass

from scgs_warp.runtime.provenance import command_line, provenance

COUNTED = 90
"""Architecture whose instructions are counted: that of an H100 or H200."""
EXPONENTIAL = "MUFU.EX2"
"""Instruction by which the loop over splats is found."""
COMPOSITING = {"forward": "composite", "adjoint": "composite_adjoint"}


def loop_counts(code: sass.Code) -> dict[str, dict[str, int]]:
    loop = sass.innermost_loop(code, EXPONENTIAL)
    return {"hit": sass.count(loop.hit), "miss": sass.count(loop.miss)}


def module_rows(name: str, tool: str, folder: Path) -> tuple[list[dict[str, Any]], dict[str, sass.Code]]:
    """Return a row for each kernel of a module, and its code."""
    paths = cubins.compile_module(name, cubins.ARCHITECTURES, folder)
    taken = {a: cubins.resources(name, path) for a, path in paths.items()}
    codes = sass.disassemble(tool, paths[COUNTED])
    by_key = {k.key: codes[f"{k.get_mangled_name()}{cubins.SUFFIX}"] for k in cubins.kernels_of(name)}
    rows = []
    for key, code in by_key.items():
        architectures = {
            str(a): {**taken[a][key]._asdict(), "occupancy": round(cubins.occupancy(taken[a][key], a), 4)}
            for a in cubins.ARCHITECTURES
        }
        counts = sass.count(code.instructions)
        rows.append({"module": name, "kernel": key, "architectures": architectures, "instructions": counts})
    return rows, by_key


def gsplat_rows(nvcc: str, tool: str, folder: Path) -> dict[str, Any]:
    """Compile gsplat's kernels; return what they take and their loops."""
    found: dict[str, Any] = {}
    for which in gsplat_kernels.FILES:
        path = gsplat_kernels.compile_kernel(nvcc, which, COUNTED, folder)
        ((symbol, taken),) = cubins.read_cubin(path.read_bytes()).items()
        taken = taken._replace(shared=taken.shared + cubins.BLOCK * gsplat_kernels.BYTES_STAGED[which])
        code = sass.disassemble(tool, path)[symbol]
        occupancy = round(cubins.occupancy(taken, COUNTED), 4)
        found[which] = {**taken._asdict(), "occupancy": occupancy, **loop_counts(code)}
    return found


def nvcc_version(nvcc: str) -> str:
    text = subprocess.run([nvcc, "--version"], capture_output=True, text=True, check=True, timeout=60).stdout
    return text.strip().splitlines()[-1]


def measure(tool: str, nvcc: str | None) -> dict[str, Any]:
    rows, loops = [], {}
    with tempfile.TemporaryDirectory() as folder:
        for name in cubins.module_names():
            if cubins.kernels_of(name):
                found, codes = module_rows(name, tool, Path(folder) / name)
                rows += found
                if name == "cuda.compositing":
                    loops["scgs_warp"] = {which: loop_counts(codes[key]) for which, key in COMPOSITING.items()}
        if nvcc is not None:
            loops["gsplat"] = gsplat_rows(nvcc, tool, Path(folder) / "gsplat")
    tools = {"nvdisasm": sass.tool_version(tool)}
    if nvcc is not None:
        tools |= {"nvcc": nvcc_version(nvcc), "gsplat": gsplat_kernels.version()}
    return {"tools": tools, "kernels": rows, "loops": loops}


def main(args: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True, help="file to write")
    parser.add_argument("--nvcc", help="CUDA compiler, to count gsplat's kernels, too")
    words = sys.argv[1:] if args is None else args
    options = parser.parse_args(words)
    tool = sass.find_tool()
    if tool is None:
        print("nvdisasm is missing: pip install nvidia-cuda-nvdisasm", file=sys.stderr)
        return 2
    origin = {**provenance("cpu"), "command": command_line("benchmarks/kernel_table.py", words)}
    result = {**origin, **measure(tool, options.nvcc)}
    options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
