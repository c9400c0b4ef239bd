"""Every kernel compiles for CUDA, proved without a GPU; and what kernels take of sm_90, pinned from above: registers of
the hot ones, no spills in frames and steps.

A kernel that takes more registers leaves fewer warps to hide latencies. The numbers stand in the cubins, which Warp
makes without a GPU (``benchmarks/kernel_table.py`` writes all of them).
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

import pytest

import scgs_warp.kernels
from helpers.scripts import benchmark_script

cubins = benchmark_script("cubins")

MODULES = sorted(
    module.name.removeprefix("scgs_warp.kernels.")
    for module in pkgutil.walk_packages(scgs_warp.kernels.__path__, "scgs_warp.kernels.")
    if not module.ispkg
)

ARCHITECTURE = 90
REGISTERS = {
    "adam": {"adam_step": 32},
    "compositing": {"finite_opacities": 24, "add_stats": 32},
    "cuda.binning": {"count_pairs": 32, "emit_by_depth": 40, "tile_ranges": 20},
    "cuda.compositing": {"composite": 40, "composite_adjoint": 64},
    "cuda.harmonics": {"spherical_harmonics": 40, "spherical_harmonics_adjoint": 40, "channels_with_depth": 40},
    "cuda.neighbors": {"nearest": 52},
    "cuda.node_sums": {"skin_segments": 64, "rbf_segments": 127, "sum_segments": 32},
    "cuda.slots": {"sum_slots": 32},
    "cuda.ssim": {"photometric": 48, "photometric_adjoint": 40},
    "encoding": {"encode": 30},
    "harmonics": {"spherical_harmonics": 32, "spherical_harmonics_adjoint": 32, "channels_with_depth": 32},
    "neighbors": {"nearest": 32, "rbf_weights": 40},
    "posing": {"unit_pose": 32, "pose_gaussians": 64},
    "projection": {"project": 48, "project_adjoint": 90},
    "skinning": {"skin": 64, "skin_adjoint": 80},
    "ssim": {"blur_rows": 40, "photometric": 32, "photometric_adjoint": 32},
}
"""Registers of the hot kernels. Steps of occupancy for blocks of 256 threads: 32 registers 100 %, 40 75 %, 48 62 %,
64 50 %, 80 38 %, 96 25 %."""
STACK = {
    "bending": {"bend": 40},  # the singular value decomposition of a stretched Gaussian, of edits alone
    "cuda.compositing_blocks": {"composite_adjoint": 48},  # more than eight channels alone
    "encoding": {"encode": 32},  # sine and cosine of large angles
    "inverse_kinematics": {"reach_place": 40},  # sine and cosine of large angles, of edits alone
    "surface_depth": {"surface_depth": 1024},  # the Gaussians of a ray; part of no frame and no step
}
"""Bytes of stack of the kernels that have one, with the reason."""
ASIDE = ("benchmark", "raycast_figure", "raycast_hits", "raycast_mesh", "solid_textures")
"""Modules that no frame and no step launches."""


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory):
    """Compile a module for all architectures, once."""
    found: dict[str, dict[int, Path]] = {}

    def compile_once(name: str) -> dict[int, Path]:
        if name not in found:
            found[name] = cubins.compile_module(name, cubins.ARCHITECTURES, tmp_path_factory.mktemp("cubins"))
        return found[name]

    return compile_once


@pytest.fixture(scope="module")
def taken(compiled):
    """What every kernel of a frame or step takes, by module and key."""
    names = [name for name in cubins.module_names() if name not in ASIDE and cubins.kernels_of(name)]
    return {name: cubins.resources(name, compiled(name)[ARCHITECTURE]) for name in names}


def test_kernels_are_discovered():
    found = {(name, kernel.key) for name in MODULES for kernel in cubins.kernels_of(name)}
    forms = ("compositing", "cpu.compositing", "cuda.compositing", "cuda.compositing_blocks")
    assert {("ssim", "photometric"), ("cpu.ssim", "photometric"), *((form, "composite") for form in forms)} <= found


@pytest.mark.parametrize("name", MODULES)
def test_compiles_for_cuda(name, compiled):
    """Block kernels are compiled for the block size they are launched with, which is Warp's default of 256."""
    kernels = cubins.kernels_of(name)
    if not kernels:
        pytest.skip("functions and constants only: the kernels that use them compile them")
    python_module = importlib.import_module(f"scgs_warp.kernels.{name}")
    assert kernels[0].module.options["block_dim"] == getattr(python_module, "BLOCK_DIM", 256) == 256
    assert not any(kernel.is_generic for kernel in kernels), "a generic kernel is compiled only when launched"
    assert cubins.ARCHITECTURES == (75, 90, 120)
    for architecture, path in compiled(name).items():
        content = path.read_bytes()
        for kernel in kernels:
            symbol = f"{kernel.get_mangled_name()}{cubins.SUFFIX}".encode()
            assert symbol in content, f"{kernel.key} is missing for sm_{architecture}"
    assert set(compiled(name)) == set(cubins.ARCHITECTURES)


def test_registers_of_hot_kernels(taken):
    lines = [
        f"kernels/{module.replace('.', '/')}.py: {key} takes {taken[module][key].registers} registers, at most {most}"
        for module, kernels in REGISTERS.items()
        for key, most in kernels.items()
        if taken[module][key].registers > most
    ]
    assert not lines, "\n".join(lines)


def test_no_kernel_of_a_frame_or_step_spills(taken):
    lines = [
        f"kernels/{module.replace('.', '/')}.py: {key} has {own.stack} bytes of stack a thread"
        for module, kernels in taken.items()
        for key, own in kernels.items()
        if own.stack > STACK.get(module, {}).get(key, 0)
    ]
    assert not lines, "\n".join(lines)


def test_a_cubin_is_read_and_nothing_else(taken):
    composite = taken["cuda.compositing"]["composite"]
    assert composite.shared >= 256 * (48 + 4) and composite.constant > 500
    with pytest.raises(ValueError, match="64-bit ELF"):
        cubins.read_cubin(b"PK\x03\x04 a wheel")


@pytest.mark.parametrize(
    ("registers", "shared", "architecture", "share"),
    [
        (32, 2048, 90, 1.0),
        (33, 2048, 90, 0.75),
        (64, 2048, 90, 0.5),
        (64, 27 * 1024, 75, 0.5),  # shared memory for two blocks
        (255, 0, 120, 1 / 6),
        (32, 100 * 1024, 90, 0.25),
    ],
)
def test_occupancy_is_limited_by_registers_and_by_shared_memory(registers, shared, architecture, share):
    own = cubins.Resources(registers, 0, shared, 0)
    assert cubins.occupancy(own, architecture) == pytest.approx(share)


SASS = """
.text.composite_abc_cuda_kernel_forward:
.L_x_1:
        /*0010*/                   FADD R1, R2, R3 ;
        /*0020*/                   LDS.128 R4, [R8] ;
        /*0030*/                   MUFU.EX2 R1, R1 ;
        /*0040*/              @!P0 BRA `(.L_x_2) ;
        /*0050*/                   FFMA R4, R4, R1, R5 ;
        /*0060*/              @!P0 REDG.E.ADD.F32 desc[UR4][R2.64], R4 ;
.L_x_2:
        /*0070*/               @P1 BRA `(.L_x_1) ;
        /*0080*/                   EXIT ;
        /*0090*/                   NOP ;
"""


def test_instructions_are_counted_by_class():
    sass = benchmark_script("sass")
    ((name, code),) = sass.parse(SASS).items()
    assert name == "composite_abc_cuda_kernel_forward"
    counts = sass.count(code.instructions)
    assert counts["all"] == 8 and counts["FP32"] == 2 and counts["atomic"] == counts["shared"] == counts["MUFU"] == 1
    loop = sass.innermost_loop(code, "MUFU.EX2")
    assert len(loop.hit) == 7 and [i.opcode for i in loop.miss] == ["FADD", "LDS.128", "MUFU.EX2", "BRA", "BRA"]
    with pytest.raises(ValueError, match="no loop"):
        sass.innermost_loop(code, "MUFU.SIN")
