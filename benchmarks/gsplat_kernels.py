"""gsplat's compositing kernels, compiled from the installed package's own source without torch, to count instructions.

Only the kernels are compiled: each file is cut where its launching function begins, and the few names that the kernels
take from torch stand in a header of a few lines. Nothing of gsplat is in this repository.
"""

from __future__ import annotations

import importlib.metadata
import subprocess
from importlib.util import find_spec
from pathlib import Path

FILES = {
    "forward": ("RasterizeToPixels3DGSFwd.cu", "rasterize_to_pixels_3dgs_fwd_kernel"),
    "adjoint": ("RasterizeToPixels3DGSBwd.cu", "rasterize_to_pixels_3dgs_bwd_kernel"),
}
CHANNELS = 3
FLAGS = ("-O3", "-use_fast_math", "-std=c++17", "--expt-relaxed-constexpr", "-w")
"""What gsplat builds with."""
INSTEAD = """#pragma once
#include <cuda_runtime.h>
inline __device__ void gpuAtomicAdd(float* at, float value) { atomicAdd(at, value); }
"""
REPLACED = ("ATen/Dispatch.h", "ATen/core/Tensor.h", "ATen/cuda/Atomic.cuh", "c10/cuda/CUDAStream.h", "Rasterization.h")
BYTES_STAGED = {"forward": 4 + 12 + 12, "adjoint": 4 + 12 + 12 + 4 * CHANNELS}
"""Dynamic shared memory of a splat: index, mean and opacity, conic; in the adjoint channels, too."""


def source() -> Path:
    """Return the folder of gsplat's CUDA sources.

    Raises:
        FileNotFoundError: gsplat is not installed.
    """
    spec = find_spec("gsplat")
    if spec is None or spec.origin is None:
        raise FileNotFoundError("gsplat is not installed: pip install gsplat==1.5.3")
    return Path(spec.origin).parent / "cuda"


def version() -> str:
    return importlib.metadata.version("gsplat")


def compile_kernel(nvcc: str, which: str, architecture: int, folder: Path) -> Path:
    """Compile the kernel of one pass for three channels; return its cubin."""
    root, (file, kernel) = source(), FILES[which]
    text = (root / "csrc" / file).read_text(encoding="utf-8")
    begin = text.rindex("template <uint32_t CDIM>", 0, text.index(f"void launch_{kernel}"))
    keep = f"__attribute__((used)) void* kept = (void*){kernel}<{CHANNELS}, float>;\n}}\n"
    folder.mkdir(parents=True, exist_ok=True)
    for name in REPLACED:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(INSTEAD, encoding="utf-8")
    unit, cubin = folder / file, folder / f"{which}.sm{architecture}.cubin"
    unit.write_text(text[:begin] + keep, encoding="utf-8")
    includes = (folder, root / "include", root / "csrc" / "third_party" / "glm")
    command = [nvcc, "-cubin", f"-arch=sm_{architecture}", *FLAGS, *(f"-I{path}" for path in includes)]
    subprocess.run([*command, str(unit), "-o", str(cubin)], check=True, timeout=600)
    return cubin
