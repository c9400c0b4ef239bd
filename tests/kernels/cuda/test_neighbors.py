"""The native CUDA search for neighbours, run on the CPU by a shim, against the portable one; the lists of pairs."""

from __future__ import annotations

import ctypes

import pytest
import torch

from helpers.cuda_emulation import COMPILER, build, launcher
from scgs_warp.kernels import neighbors as kernels
from scgs_warp.kernels.cuda import neighbors as cuda_kernels
from scgs_warp.ops import cuda_blocks
from scgs_warp.ops.neighbors import nearest, node_lists
from scgs_warp.runtime.launch import launch

emulated = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler, or not Linux, whose fibres the shim uses")


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return build(tmp_path_factory.mktemp("shim"))


def grid(seed: int, count: int, dimensions: int) -> torch.Tensor:
    """Return points with few digits, whose distances no form rounds; many are equal."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(-6, 7, (count, dimensions), generator=generator) / 4


def searched(library: ctypes.CDLL, points: torch.Tensor, nodes: torch.Tensor, k: int, seed: int = 0):
    """Return the results of the native and of the portable form."""
    found = []
    for native in (True, False):
        indices = torch.full((len(points), k), -7, dtype=torch.int32)
        arguments = points, nodes, k, indices, torch.full((len(points), k), -7.0)
        if native:
            launcher(library, seed)(cuda_kernels.nearest, -(-len(points) // cuda_kernels.BLOCK_DIM), *arguments)
        else:
            launch(kernels.nearest, len(points), *arguments)
        found.append(arguments[3:])
    return found


@emulated
@pytest.mark.parametrize("k", [1, 2, 3, 4])
@pytest.mark.parametrize(("count", "nodes"), [(1, 4), (256, 255), (300, 256), (257, 600), (40, 257)])
def test_same_as_the_portable_form(count: int, nodes: int, k: int, library: ctypes.CDLL):
    """Ties included; blocks of points and of nodes that are full, not full, or have one entry more."""
    for dimensions in range(1, cuda_kernels.MAX_DIMENSIONS + 1):
        native, portable = searched(library, grid(1, count, dimensions), grid(2, nodes, dimensions), k, dimensions)
        assert all(torch.equal(a, b) for a, b in zip(native, portable)), dimensions


@emulated
def test_random_points(library: ctypes.CDLL):
    generator = torch.Generator().manual_seed(3)
    points, nodes = (torch.randn(n, 11, generator=generator) for n in (500, 400))
    native, portable = searched(library, points, nodes, 4)
    assert torch.equal(native[0], portable[0])
    torch.testing.assert_close(native[1], portable[1], rtol=1e-6, atol=0.0)


@emulated
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 3e30])
def test_poison(value: float, library: ctypes.CDLL):
    """What is infinitely far or NaN never enters a list, which begins as 0, 1, 2, 3."""
    points, nodes = grid(4, 50, 3), grid(5, 20, 3)
    nodes[:5, 1], nodes[9, 0], points[7, 2], points[8] = value, -value, value, value
    native, portable = searched(library, points, nodes, 4)
    assert all(torch.equal(a, b) for a, b in zip(native, portable))
    nodes[:] = -value
    native, portable = searched(library, points, nodes, 3)
    assert all(torch.equal(a, b) for a, b in zip(native, portable))
    assert native[0].tolist() == [[0, 1, 2]] * 50 and bool((native[1] == torch.inf).all())


@pytest.mark.parametrize(("k", "dimensions", "native"), [(4, 12, True), (1, 3, True), (5, 3, False), (4, 13, False)])
def test_which_form_a_gpu_runs(device: str, k: int, dimensions: int, native: bool, monkeypatch):
    points, nodes = grid(6, 30, dimensions).to(device), grid(7, 20, dimensions).to(device)
    names, inner = [], cuda_blocks.launch_native

    def noting(kernel, blocks, *args, begin=0):
        names.append(kernel.key)
        inner(kernel, blocks, *args, begin=begin)

    monkeypatch.setattr(cuda_blocks, "launch_native", noting)
    indices, distances = nearest(points, nodes, k)
    assert names == (["nearest"] if native and device == "cuda" else [])
    expected = nearest(points.cpu(), nodes.cpu(), k)
    assert torch.equal(indices.cpu(), expected[0]) and torch.equal(distances.cpu(), expected[1])


def sorted_lists(indices: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what ``node_lists`` should, by a stable sort of everything."""
    nodes, order = torch.sort(indices.reshape(-1).cpu(), stable=True)
    return order.int(), torch.searchsorted(nodes, torch.arange(count + 1, dtype=torch.int32), out_int32=True)


@pytest.mark.parametrize("count", [1, 2, 3, 31, 255, 256, 257, 512, 1023])
@pytest.mark.parametrize("rows", [0, 1, 700])
def test_lists_of_pairs(count: int, rows: int, device: str):
    """Counts of nodes on both sides of a power of two, nodes without pairs, and pairs without a node."""
    generator = torch.Generator().manual_seed(count)
    for least, most in ((0, count), (-1, count), (count - 1, count), (0, max(count // 2, 1)), (-1, 0)):
        indices = torch.randint(least, most, (rows, 4), generator=generator, dtype=torch.int32)
        kept = indices.clone()
        moved = indices.to(device)
        order, begin = node_lists(moved, count)
        expected_order, expected_begin = sorted_lists(kept, count)
        assert torch.equal(order.cpu(), expected_order) and torch.equal(begin.cpu(), expected_begin)
        assert torch.equal(moved.cpu(), kept), "the indices are an input"
