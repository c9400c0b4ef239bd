"""Correctives that follow the rotation of their surface: against float64, their bound, and non-finite values."""

from __future__ import annotations

import math

import pytest
import torch

from helpers.gradients import value_and_gradients
from reference.correctives import correct as correct_reference
from reference.quaternion import multiply, normalise, to_matrix
from scgs_warp.ops.correctives import COLUMNS, correct

NAMES = ("means", "correctives", "quats", "quats_t")


def draw(seed, n, device="cpu"):
    g = torch.Generator().manual_seed(seed)
    widths = (3, COLUMNS, 4, 4)
    return [torch.randn(n, width, generator=g).to(device) for width in widths]


@pytest.mark.parametrize("n", [0, 1, 2, 257])
@pytest.mark.parametrize("seed", range(3))
def test_values_and_gradients(seed, n, device):
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
def test_values_and_gradients_under_an_edit(n, device):
    """The displacement of the motion's own rotation, carried along by the edited one."""
    inputs, own = draw(7, n, device), draw(8, n, device)[3]
    weights = torch.randn(n, 3, generator=torch.Generator().manual_seed(7))
    ours, ours_grad = value_and_gradients(lambda *x: correct(*x, own), inputs, weights)
    doubles = [x.double() for x in inputs]
    theirs, theirs_grad = value_and_gradients(lambda *x: correct_reference(*x, own.double()), doubles, weights)
    torch.testing.assert_close(ours.double(), theirs, rtol=1e-5, atol=1e-5)
    for a, b in zip(ours_grad[:2], theirs_grad[:2], strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-5, atol=1e-5)


def test_a_common_rotation_of_both_changes_nothing_but_the_frame(device):
    """An edit that turns everything by q turns the displacements by q, whatever it is."""
    means, correctives, quats, quats_t = draw(9, 60, device)
    q = normalise(torch.tensor([[0.3, -0.5, 0.7, 0.2]], device=device))
    zero = torch.zeros_like(means)
    before = correct(zero, correctives, quats, quats_t)
    after = correct(zero, correctives, quats, multiply(q.expand(60, 4), normalise(quats_t)), quats_t)
    torch.testing.assert_close(after, before @ to_matrix(q)[0].T, rtol=1e-4, atol=1e-5)


def test_nothing_moves_at_rest_whatever_the_norm(device):
    means, correctives, quats, _ = draw(5, 50, device)
    torch.testing.assert_close(correct(means, correctives, quats, -3.0 * quats), means, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 3e38])
def test_non_finite_values_move_nothing_and_pass_no_gradient(bad, device):
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


@pytest.mark.parametrize("which", range(4))
def test_wrong_shapes_are_named(which):
    inputs = draw(0, 3)
    inputs[which] = inputs[which][:, :-1]
    with pytest.raises(ValueError, match=NAMES[which]):
        correct(*inputs)
