"""Correctives that follow the rotation of their surface: against float64, their bound, and non-finite values."""

from __future__ import annotations

import functools
import math

import pytest
import torch

from helpers.gradients import value_and_gradients
from reference.correctives import correct as correct_reference
from reference.quaternion import multiply, normalise, to_matrix
from scgs_warp.ops import correctives as ops
from scgs_warp.ops.correctives import COLUMNS
from scgs_warp.runtime import environment

NAMES = ("means", "correctives", "quats", "quats_t")


@pytest.fixture(params=["plain", "cpu"])
def correct(request, device):
    if request.param == "cpu" and device != "cpu":
        pytest.skip("SIMD is for the CPU")
    return functools.partial(ops.correct, form=request.param)


def draw(seed, n, device="cpu"):
    g = torch.Generator().manual_seed(seed)
    widths = (3, COLUMNS, 4, 4)
    return [torch.randn(n, width, generator=g).to(device) for width in widths]


@pytest.mark.parametrize("n", [0, 1, 2, 16, 257])
@pytest.mark.parametrize("seed", range(3))
def test_values_and_gradients(seed, n, device, correct):
    inputs = draw(seed, n, device)
    weights = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))
    ours, ours_grad = value_and_gradients(correct, inputs, weights)
    theirs, theirs_grad = value_and_gradients(correct_reference, [x.double() for x in inputs], weights)
    assert ours.shape == (n, 3) and ours.device.type == device
    torch.testing.assert_close(ours.double(), theirs, rtol=1e-5, atol=1e-5)
    for a, b in zip(ours_grad[:2], theirs_grad[:2], strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-5, atol=1e-5)
    assert ours_grad[2:] == [None, None], "training must not turn surfaces to move them"


@pytest.mark.parametrize("n", [1, 257])
def test_values_and_gradients_under_an_edit(n, device, correct):
    """The displacement of the motion's own rotation, carried along by the edited one."""
    inputs, own = draw(7, n, device), draw(8, n, device)[3]
    weights = torch.randn(n, 3, generator=torch.Generator().manual_seed(7))
    ours, ours_grad = value_and_gradients(lambda *x: correct(*x, own), inputs, weights)
    doubles = [x.double() for x in inputs]
    theirs, theirs_grad = value_and_gradients(lambda *x: correct_reference(*x, own.double()), doubles, weights)
    torch.testing.assert_close(ours.double(), theirs, rtol=1e-5, atol=1e-5)
    for a, b in zip(ours_grad[:2], theirs_grad[:2], strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-5, atol=1e-5)


def test_a_common_rotation_of_both_changes_nothing_but_the_frame(device, correct):
    """An edit that turns everything by q turns the displacements by q, whatever it is."""
    means, correctives, quats, quats_t = draw(9, 60, device)
    q = normalise(torch.tensor([[0.3, -0.5, 0.7, 0.2]], device=device))
    zero = torch.zeros_like(means)
    before = correct(zero, correctives, quats, quats_t)
    after = correct(zero, correctives, quats, multiply(q.expand(60, 4), normalise(quats_t)), quats_t)
    torch.testing.assert_close(after, before @ to_matrix(q)[0].T, rtol=1e-4, atol=1e-5)


def test_nothing_moves_at_rest_whatever_the_norm(device, correct):
    means, correctives, quats, _ = draw(5, 50, device)
    torch.testing.assert_close(correct(means, correctives, quats, -3.0 * quats), means, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 3e38])
def test_non_finite_values_move_nothing_and_pass_no_gradient(bad, device, correct):
    means, correctives, quats, quats_t = draw(2, 4, device)
    correctives[0, 3] = bad
    correctives[0, 4] = bad
    quats_t[1, 2] = bad
    quats[2, 0] = bad
    correctives.requires_grad_()
    out = correct(means, correctives, quats, quats_t)
    assert torch.isfinite(out).all()
    if not math.isfinite(bad):
        torch.testing.assert_close(out[0], means[0], rtol=0, atol=0)
    out.sum().backward()
    assert torch.isfinite(correctives.grad).all() and correctives.grad[3].any()


def test_forms_agree_on_what_to_leave_out():
    """Extreme and non-finite values, one kind in each row: the SIMD form leaves out the displacements and gradients
    that the portable form does, and no others."""
    means, correctives, quats, quats_t = draw(3, 40)
    extremes = (math.nan, math.inf, -math.inf, 3e38, -3e38, 1e30, 0.0)
    for row, value in enumerate(extremes):
        for offset, tensor in enumerate((means, correctives, quats, quats_t)):
            tensor[4 * row + offset, 2] = value
    quats[30], quats_t[31] = 0.0, 0.0
    weights = torch.randn(40, 3, generator=torch.Generator().manual_seed(3))
    weights[32], weights[33, 1] = 3e38, math.nan
    plain, plain_grad = value_and_gradients(
        functools.partial(ops.correct, form="plain"), [means, correctives, quats, quats_t], weights
    )
    lanes, lanes_grad = value_and_gradients(
        functools.partial(ops.correct, form="cpu"), [means, correctives, quats, quats_t], weights
    )
    torch.testing.assert_close(lanes, plain, rtol=1e-5, atol=1e-5, equal_nan=True)
    torch.testing.assert_close(lanes_grad[1], plain_grad[1], rtol=1e-4, atol=1e-5, equal_nan=True)
    assert not plain_grad[1][33].any() and plain_grad[1][34].any()


def test_the_cpu_takes_the_simd_form():
    inputs = draw(6, 50)
    torch.testing.assert_close(ops.correct(*inputs), ops.correct(*inputs, form="cpu"), rtol=0, atol=0)
    assert not torch.equal(ops.correct(*inputs), ops.correct(*inputs, form="plain")), "the forms round differently"


def test_same_bits_for_any_thread_count(all_threads):
    inputs, weights = draw(4, 5000), torch.randn(5000, 3, generator=torch.Generator().manual_seed(0))
    results = []
    for threads in (1, 2, 3):
        environment.configure(threads=threads)
        ours, gradients = value_and_gradients(ops.correct, inputs, weights, learnt=2)
        results.append([ours, *gradients])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))
