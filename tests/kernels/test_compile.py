"""Every kernel compiles for CUDA, proved without a GPU: a cubin for each architecture holds each kernel's symbol."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType

import pytest
import warp as wp

import scgs_warp.kernels
from scgs_warp.runtime import launch  # noqa: F401  (initialises Warp quietly)

ARCHITECTURES = (75, 90, 120)
MODULES = sorted(
    module.name.removeprefix("scgs_warp.kernels.")
    for module in pkgutil.walk_packages(scgs_warp.kernels.__path__, "scgs_warp.kernels.")
    if not module.ispkg
)


def _import(name: str) -> ModuleType:
    return importlib.import_module(f"scgs_warp.kernels.{name}")


def _own_kernels(module: ModuleType) -> list[wp.Kernel]:
    return [k for k in vars(module).values() if isinstance(k, wp.Kernel) and k.module.name == module.__name__]


def test_kernels_are_discovered():
    found = {(name, kernel.key) for name in MODULES for kernel in _own_kernels(_import(name))}
    forms = ("compositing", "cpu.compositing", "cuda.compositing", "cuda.compositing_blocks")
    assert {("ssim", "photometric"), ("cpu.ssim", "photometric"), *((form, "composite") for form in forms)} <= found


@pytest.mark.parametrize("name", MODULES)
def test_compiles_for_cuda(name, tmp_path):
    """Block kernels are compiled for the block size they are launched with, which is Warp's default of 256."""
    python_module = _import(name)
    kernels = _own_kernels(python_module)
    if not kernels:
        pytest.skip("functions and constants only: the kernels that use them compile them")
    module = kernels[0].module
    assert module.options["block_dim"] == getattr(python_module, "BLOCK_DIM", 256) == 256
    assert not any(kernel.is_generic for kernel in kernels), "a generic kernel is compiled only when launched"
    artifacts = wp.compile_aot_module(module, arch=ARCHITECTURES, module_dir=tmp_path, use_ptx=False)
    for architecture in ARCHITECTURES:
        (binary,) = (path for path in artifacts if path.name.endswith(f".sm{architecture}.cubin"))
        content = binary.read_bytes()
        for kernel in kernels:
            symbol = f"{kernel.get_mangled_name()}_cuda_kernel_forward".encode()
            assert symbol in content, f"{kernel.key} is missing for sm_{architecture}"
