"""The native CUDA bodies, run on the CPU by ``cuda_emulation``, under the laws of the stages that they compute."""

from __future__ import annotations

import ctypes
import functools
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fuzz.cases_render import case_harmonics, check_composite, splats_of
from fuzz.cases_training import case_loss
from fuzz.poison import Draw
from helpers.cuda_emulation import COMPILER, build, launcher
from scgs_warp.kernels import compositing
from scgs_warp.ops import compositing_cuda, cuda_blocks
from scgs_warp.runtime.kernel_arguments import parameters_of
from scgs_warp.runtime.launch import launch

from . import fence


@functools.lru_cache(maxsize=1)
def library() -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as folder:
        return build(Path(folder))


@contextmanager
def emulated(seed: int) -> Iterator[None]:
    native, blocks_of = cuda_blocks.launch_native, compositing_cuda.launch_blocks
    run = launcher(library(), seed)

    def fenced_native(kernel: Any, blocks: int, *args: Any, begin: int = 0) -> None:
        if fence.current is None:
            run(kernel, blocks, *args, begin=begin)
        else:
            fence.current.run(kernel, parameters_of(kernel), args, lambda own: run(kernel, blocks, *own, begin=begin))

    def portable(kernel: Any, blocks: int, *args: Any, block_dim: int, begin: int = 0) -> None:
        launch(compositing.composite_adjoint, blocks, *args, begin=begin)

    cuda_blocks.launch_native, compositing_cuda.launch_blocks = fenced_native, portable  # type: ignore[assignment]
    try:
        yield
    finally:
        cuda_blocks.launch_native, compositing_cuda.launch_blocks = native, blocks_of


def case_native_compositing(d: Draw, device: str) -> None:
    """Images and gradients are finite, and invalid splats change nothing; on a GPU the device's own kernels run."""
    splats, channels_count = splats_of(d, device), int(d.pick((1, 3, 4, 8, 9)))
    count = len(splats.means2d)
    if device == "cpu" and (splats.width * splats.height > 1100 or count > 100):
        return  # a second or more, thread by thread
    channels, background = d.normal(count, channels_count), d.uniform(channels_count)
    if d.chance():
        d.poison(channels, d.rows(count))
    if device != "cpu":
        check_composite(d, splats, channels.to(device), background.to(device), "cuda")
        return
    with emulated(d.seed % 1000):
        check_composite(d, splats, channels, background, "cuda")


def case_native_loss(d: Draw, device: str) -> None:
    if device != "cpu":
        case_loss(d, device, "cuda")
        return
    with emulated(d.seed % 1000):
        case_loss(d, device, "cuda")


def case_native_harmonics(d: Draw, device: str) -> None:
    if device != "cpu":
        case_harmonics(d, device, "cuda")
        return
    with emulated(d.seed % 1000):
        case_harmonics(d, device, "cuda")


NATIVE = {
    "cuda bodies": (case_native_compositing, 1),
    "cuda harmonics": (case_native_harmonics, 1),
    "cuda loss": (case_native_loss, 1),
}
CASES = NATIVE if COMPILER is not None else {}
