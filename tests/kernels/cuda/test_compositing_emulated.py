"""The native CUDA form of compositing, run on the CPU by a shim, against the plain form: images, gradients, bits."""

from __future__ import annotations

import ctypes
from typing import Any

import pytest
import torch

from helpers.compositing_forms import CASES, largest_differences, run_form
from helpers.cuda_emulation import COMPILER, build, launcher
from scgs_warp.kernels import compositing
from scgs_warp.kernels.cuda.slots import SLOT_WIDTH
from scgs_warp.ops import compositing_cuda, cuda_blocks
from scgs_warp.runtime.launch import launch

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler, or not Linux, whose fibres the shim uses")


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return build(tmp_path_factory.mktemp("shim"))


def emulate(monkeypatch: pytest.MonkeyPatch, library: ctypes.CDLL, seed: int = 0) -> None:
    """Native launches go to the shim; those of the portable form, which the native one leaves many channels to, to the
    plain form."""

    def portable(kernel: Any, blocks: int, *args: Any, block_dim: int, begin: int = 0) -> None:
        assert kernel.key == "composite_adjoint"
        launch(compositing.composite_adjoint, blocks, *args, begin=begin)

    monkeypatch.setattr(cuda_blocks, "launch_native", launcher(library, seed))
    monkeypatch.setattr(compositing_cuda, "launch_blocks", portable)


@pytest.mark.parametrize("case", CASES)
def test_same_as_the_pixel_form(case: str, library: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch):
    emulate(monkeypatch, library)
    differences = largest_differences(case, "cuda", "cpu")
    assert max(differences) < 1e-5, differences


@pytest.mark.parametrize("case", ("odd size", "several batches and early stop"))
def test_bits_do_not_depend_on_who_runs_first(case: str, library: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch):
    runs = []
    for seed in (1, 2):
        emulate(monkeypatch, library, seed)
        runs.append(run_form(case, "cuda", "cpu"))
    assert all(torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(*runs))


@pytest.mark.parametrize("channels", (1, 8))
def test_slots_are_summed_column_by_column(device: str, channels: int):
    generator = torch.Generator().manual_seed(channels)
    counts = torch.randint(0, 5, (40,), generator=generator)
    offsets = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)]).to(device)
    slots = torch.randn(int(counts.sum()), SLOT_WIDTH, generator=generator).to(device)
    found = []
    for form in ("cuda", "blocks"):
        outputs = tuple(torch.full((40, *shape), 7.0, device=device) for shape in ((2,), (3,), (), (channels,), (2,)))
        compositing_cuda.sum_slots(form, offsets, slots, outputs)
        found.append(outputs)
    assert all(torch.equal(a, b) for a, b in zip(*found))
    compositing_cuda.sum_slots("cuda", offsets, slots, (*outputs[:4], None))


def test_the_native_form_needs_a_gpu():
    with pytest.raises(RuntimeError, match="needs a GPU"):
        run_form("one tile", "cuda", "cpu")
