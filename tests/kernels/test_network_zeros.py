"""Products with hidden values and gradients that are zero are left out of the network's sums on a CPU."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from helpers.networks import parameters, rows
from reference.network import network as twin
from scgs_warp.ops import network as ops
from scgs_warp.ops.network import Layers, network

SHAPE = (63, 13, [256] * 4, {2}, 7)
WIDE = (9, 2, [1600, 1600, 32], set(), 3)
"""Wider than the longest list of columns."""
SPARSE, HALF, FULL = -0.6, 0.0, 3.0
"""Biases with which few, half or most hidden values are above zero."""


@pytest.fixture(autouse=True)
def without_tiles(monkeypatch):
    """Tiles read whole matrices."""
    monkeypatch.setattr(ops, "pair_products", lambda: 1)


def biased(shape: tuple, bias: float, seed: int = 31) -> tuple[list[Tensor], list[Tensor]]:
    weights, biases = parameters(shape, seed)
    with torch.no_grad():
        for own in biases[:-1]:
            own.add_(bias)
    return weights, biases


def in_full(monkeypatch) -> None:
    """Let the kernels read every matrix in full, as they do where a weight is not finite."""
    pack = Layers._pack
    monkeypatch.setattr(Layers, "_pack", lambda self: (pack(self), self.finite.zero_())[0])


@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("shape", [SHAPE, WIDE])
@pytest.mark.parametrize("bias", [SPARSE, HALF, FULL])
@pytest.mark.parametrize("positions", [1, 9, 70])
def test_leaving_out_zeros_changes_no_bit(positions, bias, shape, bfloat16, monkeypatch):
    weights, biases = biased(shape, bias)
    where, when = rows(shape, positions, 2, 31)
    v = torch.randn(2 * positions, shape[4], generator=torch.Generator().manual_seed(31))

    def results() -> list[Tensor]:
        out = network(where, when, weights, biases, bfloat16=bfloat16)
        return [out, *torch.autograd.grad(out, (*weights, *biases), v)]

    short = results()
    in_full(monkeypatch)
    assert all(torch.equal(a, b) for a, b in zip(short, results(), strict=True))


@pytest.mark.parametrize("bias, least, most", [(SPARSE, 0.7, 0.99), (HALF, 0.3, 0.7), (FULL, 0.0, 0.3)])
def test_the_biases_of_these_tests_give_few_and_many_zeros(bias, least, most):
    weights, biases = biased(SHAPE, bias)
    with torch.no_grad():
        _, hidden, _ = Layers(weights, biases, 76, adjoint=True).values(*rows(SHAPE, 64, 1, 31), keep=True)
    assert least <= float((hidden[:-1] == 0).float().mean()) <= most


def test_where_all_hidden_values_are_zero_the_bias_remains():
    weights, biases = biased(SHAPE, -100.0)
    out = network(*rows(SHAPE, 20, 1, 31), weights, biases)
    assert torch.equal(out, biases[-1].expand_as(out))
    gradients = torch.autograd.grad(out.sum(), (*weights, *biases))
    assert not any(bool(gradient.any()) for gradient in gradients[:-1]) and bool((gradients[-1] == 20).all())


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("layer", [1, 2, 4])
def test_a_weight_that_is_not_finite_reaches_every_row(layer, bad):
    """Zero times it is NaN, so the rows that read only zeros there are spoilt, too."""
    weights, biases = biased(SHAPE, SPARSE)
    where, when = rows(SHAPE, 40, 1, 31)
    with torch.no_grad():
        weights[layer - 1][-1] = 0.0
        biases[layer - 1][-1] = -1.0  # the last unit of the layer before is zero everywhere
        weights[layer][0, -1] = bad
        before = network(where, when, weights, biases)
        hidden = Layers(weights, biases, 76, adjoint=True).values(where, when, keep=True)[1]
    if layer < 4:
        assert bool(hidden[layer].view(-1, 40, 32)[0, :, 0].isnan().all())
    else:
        assert bool(before[:, 0].isnan().all())


@pytest.mark.parametrize("bfloat16", [False, True])
def test_a_gradient_of_zero_that_meets_a_weight_that_is_not_finite_is_nan(bfloat16):
    weights, biases = ([p.detach() for p in group] for group in biased(SHAPE, SPARSE))
    where, when = rows(SHAPE, 40, 1, 31)
    biases[2][5] = 10.0  # unit 5 of the layer before the last hidden one is above zero everywhere
    weights[3][:32] = 0.0
    biases[3][:32] = -1.0  # a panel of the last hidden layer is zero everywhere, and so is its gradient
    inputs, hidden, out = Layers(weights, biases, 76, adjoint=True).values(where, when, keep=True)
    panels = hidden.view(len(hidden), -1, hidden.shape[1], 32)
    assert bool((panels[2, 0, :40, 5] > 0).all()) and not bool(panels[3, 0].any())
    for bad in (0.0, float("nan")):
        weights[3][0, 5] = bad
        layers = Layers(weights, biases, 76, adjoint=True, bfloat16=bfloat16)
        _, gradients = layers.gradients(inputs, hidden, torch.ones_like(out), None)
        assert bool(gradients[2][5].isnan().all()) == (bad != bad)


def test_the_twin_agrees_where_most_hidden_values_are_zero():
    weights, biases = biased(SHAPE, SPARSE)
    where, when = rows(SHAPE, 70, 1, 31)
    out = network(where, when, weights, biases)
    own = [p.detach().double().requires_grad_() for p in (*weights, *biases)]
    half = len(weights)
    expected = twin(where.double(), when.double(), own[:half], own[half:])
    torch.testing.assert_close(out.double(), expected, rtol=1e-5, atol=1e-6)
    v = torch.randn(out.shape, generator=torch.Generator().manual_seed(32))
    gradients = torch.autograd.grad(out, (*weights, *biases), v)
    for got, want in zip(gradients, torch.autograd.grad(expected, own, v.double()), strict=True):
        assert float((got.double() - want).norm() / want.norm().clamp_min(1e-6)) < 1e-4
