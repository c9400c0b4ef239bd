"""The native CUDA form of spherical harmonics, run on the CPU by a shim, against the portable form and float64."""

from __future__ import annotations

import ctypes

import pytest
import torch
from torch import Tensor

from helpers.cuda_emulation import COMPILER, build, launcher
from helpers.scenes import random_camera
from reference.harmonics import spherical_harmonics as harmonics_reference
from scgs_warp.kernels.cuda.harmonics import GAUSSIANS
from scgs_warp.ops import cuda_blocks, harmonics

emulated = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler, or not Linux, whose fibres the shim uses")
CAMERA = torch.tensor([0.5, -3.0, 2.0])
COUNTS = (1, 5, GAUSSIANS - 1, GAUSSIANS, GAUSSIANS + 1, 2 * GAUSSIANS + 77)
LAYOUTS = ("split", "whole")


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    return build(tmp_path_factory.mktemp("shim"))


@pytest.fixture
def native(library: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_blocks, "launch_native", launcher(library))


def inputs_of(count: int, rest: int) -> list[Tensor]:
    """Return sh_dc, sh_rest, means and camera; a quarter of the colours is clamped."""
    generator = torch.Generator().manual_seed(count + rest)
    sizes = (count, 3), (count, rest, 3), (count, 3)
    dc, higher, means = (torch.randn(size, generator=generator) for size in sizes)
    return [dc, 0.3 * higher, means, CAMERA.clone()]


def colors(form: str, layout: str, leaves: list[Tensor], degree: int) -> Tensor:
    if layout == "split":
        return harmonics.spherical_harmonics(*leaves, degree, form=form)  # type: ignore[arg-type]
    sh = torch.cat([leaves[0][:, None], leaves[1]], 1)
    return harmonics._WholeHarmonics.apply(sh, *leaves[2:], degree, form)  # type: ignore[return-value]


def run(form: str, layout: str, inputs: list[Tensor], degree: int, weights: Tensor) -> list[Tensor]:
    """Return colours, and the gradients of all inputs; missing ones are zeros."""
    leaves = [x.clone().requires_grad_() for x in inputs]
    output = colors(form, layout, leaves, degree)
    gradients = torch.autograd.grad(output, leaves, weights, allow_unused=True)
    return [output.detach(), *(torch.zeros_like(x) if g is None else g for x, g in zip(leaves, gradients))]


def weights_of(count: int) -> Tensor:
    """Return gradients of colours; those of every fourth Gaussian are zero, as of a culled one."""
    weights = torch.randn(count, 3, generator=torch.Generator().manual_seed(count))
    weights[1::4] = 0.0
    return weights


def close(got: list[Tensor], expected: list[Tensor]) -> None:
    """Compare bits but for rounding: sums of the two forms have another order, and are of numbers of order one."""
    for name, a, b in zip(("colours", "sh_dc", "sh_rest", "means", "camera"), got, expected, strict=True):
        scale = float(b.abs().nan_to_num(0.0, 0.0, 0.0).max()) if b.numel() else 0.0
        torch.testing.assert_close(
            a, b, rtol=1e-6, atol=1e-6 * scale, equal_nan=True, msg=lambda text, name=name: f"{name}: {text}"
        )


@emulated
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("count", COUNTS)
def test_same_as_the_portable_form(count: int, degree: int, layout: str, native: None):
    """Rows end at the degree, hold more, are longer than those that fit in shared memory, or of even length."""
    needed = (degree + 1) ** 2 - 1
    for rest in sorted({needed, needed + 1, 15, 16, 24}):
        inputs, weights = inputs_of(count, rest), weights_of(count)
        got = run("cuda", layout, inputs, degree, weights)
        close(got, run("plain", layout, inputs, degree, weights))
        assert not got[2][:, needed:].any() and not got[2][1::4].any()
        assert torch.equal(got[2], run("plain", layout, inputs, degree, weights)[2]), "single products"


@emulated
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("degree", range(4))
def test_same_as_the_definition(degree: int, layout: str, native: None):
    inputs, weights = inputs_of(200, 15), weights_of(200)
    got = run("cuda", layout, inputs, degree, weights)
    leaves = [x.double().requires_grad_() for x in inputs]
    expected = harmonics_reference(*leaves, degree)
    gradients = torch.autograd.grad(expected, leaves, weights.double(), allow_unused=True)
    torch.testing.assert_close(got[0].double(), expected, rtol=1e-5, atol=5e-6)
    for ours, twin in zip(got[1:], gradients):
        twin = torch.zeros_like(ours, dtype=torch.float64) if twin is None else twin
        torch.testing.assert_close(ours.double(), twin, rtol=1e-4, atol=2e-5)


@emulated
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("degree", range(4))
def test_broken_rows_stay_alone(degree: int, layout: str, native: None):
    """A NaN reaches neither its neighbours, nor the gradients of a Gaussian whose own is zero."""
    inputs, weights = inputs_of(150, 15), weights_of(150)
    whole = run("cuda", layout, inputs, degree, weights)
    for row in (0, 1, 126, 129, 149):  # culled ones among them: 1 and 129
        inputs[1][row] = float("nan")
    inputs[0][3] = float("inf")
    inputs[2][5] = float("nan")
    inputs[2][6] = inputs[3]  # no direction
    inputs[2][8] = inputs[3] + 1e-30
    inputs[2][10] = 1e30
    weights[12] = float("nan")
    weights[14] = 1e38
    inputs[2][16] = inputs[3] + torch.tensor([1e-3, 0.0, 0.0])
    weights[16] = 3e37  # its mean's gradient would overflow
    got, plain = (run(form, layout, inputs, degree, weights) for form in ("cuda", "plain"))
    broken = [0, 1, 3, 5, 6, 8, 10, 12, 14, 16, 126, 129, 149]
    valid = torch.ones(150, dtype=torch.bool)
    valid[broken] = False
    for a, b in zip(got[:4], whole):
        assert torch.equal(a[valid], b[valid])
    for row in broken:
        close([x[row : row + 1] for x in got[:4]] + [CAMERA], [x[row : row + 1] for x in plain[:4]] + [CAMERA])
    assert all(x[[1, 129]].isfinite().all() for x in got[1:4])
    if degree > 0:
        assert got[0][[0, 1, 126]].isnan().all() and not got[3][16].any()


@emulated
@pytest.mark.parametrize("degree", [0, 2, 3])
@pytest.mark.parametrize("wanted", [(), (1,), (2,), (3,), (1, 2)])
def test_gradients_that_nobody_wants_are_not_written(wanted: tuple[int, ...], degree: int, native: None):
    inputs, weights = inputs_of(140, 15), weights_of(140)
    expected = run("cuda", "split", inputs, degree, weights)[1:]
    leaves = [x.clone().requires_grad_(k == 0 or k in wanted) for k, x in enumerate(inputs)]
    colors("cuda", "split", leaves, degree).backward(weights)
    for k, leaf in enumerate(leaves):
        if k == 0 or (k in wanted and (k == 1 or degree > 0)):
            assert leaf.grad is not None and torch.equal(leaf.grad, expected[k]), k
        else:
            assert leaf.grad is None


@emulated
@pytest.mark.parametrize("degree", [1, 3])
def test_rows_at_any_address(degree: int, native: None):
    """Rows that begin beside a multiple of 16 bytes are copied in smaller pieces."""
    dc, rest, means, camera = inputs_of(131, 15)
    weights = weights_of(131)
    base = torch.zeros(rest.numel() + 1)
    moved = base[1:].view_as(rest)
    moved.copy_(rest)
    assert moved.data_ptr() % 16 != 0 and rest.data_ptr() % 16 == 0
    leaves = [[x.detach().requires_grad_() for x in (dc, given, means, camera)] for given in (rest, moved)]
    aligned, other = (harmonics.spherical_harmonics(*own, degree, form="cuda") for own in leaves)
    assert torch.equal(aligned, other)
    gradients = [torch.autograd.grad(out, own, weights) for out, own in zip((aligned, other), leaves)]
    assert all(torch.equal(a, b) for a, b in zip(*gradients))


@emulated
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("count", COUNTS)
def test_colours_beside_depths(count: int, degree: int, native: None):
    camera = random_camera(4, 60, 40, "cpu")
    depths = torch.rand(count, generator=torch.Generator().manual_seed(count))
    for rest in sorted({(degree + 1) ** 2 - 1, 15}):
        harmonics_of = *inputs_of(count, rest)[:3], camera.viewmat, depths, degree
        got = harmonics.colors_and_depths(*harmonics_of, form="cuda")
        expected = harmonics.colors_and_depths(*harmonics_of, form="plain")
        torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-6)
        assert torch.equal(got[:, 3], depths)


@emulated
@pytest.mark.parametrize("layout", LAYOUTS)
def test_bits_do_not_depend_on_who_runs_first(layout: str, library: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch):
    inputs, weights = inputs_of(300, 15), weights_of(300)
    runs = []
    for seed in (1, 2, 3):
        monkeypatch.setattr(cuda_blocks, "launch_native", launcher(library, seed))
        runs.append([run("cuda", layout, inputs, degree, weights) for degree in (2, 3)])
    for other in runs[1:]:
        assert all(torch.equal(a, b) for own, first in zip(other, runs[0]) for a, b in zip(own, first))


def test_the_form_needs_a_gpu():
    with pytest.raises(RuntimeError, match="needs a GPU"):
        harmonics.spherical_harmonics(*inputs_of(4, 3), 1, form="cuda")
