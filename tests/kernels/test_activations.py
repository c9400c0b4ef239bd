"""Exponential and sigmoid functions against float64: values, gradients, extremes, and the number of threads."""

from __future__ import annotations

import math

import pytest
import torch

from helpers.gradients import value_and_gradients
from scgs_warp.ops.activations import exponential, sigmoid
from scgs_warp.runtime import environment

FUNCTIONS = {exponential: torch.exp, sigmoid: torch.sigmoid}


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("shape", [(0,), (1,), (16,), (257, 3)])
def test_values_and_gradients(function, shape, device):
    random = torch.Generator().manual_seed(len(shape))
    values, weights = 8.0 * torch.randn(shape, generator=random), torch.randn(shape, generator=random)
    ours, (ours_grad,) = value_and_gradients(function, [values.to(device)], weights.to(device))
    twin, (twin_grad,) = value_and_gradients(FUNCTIONS[function], [values.double()], weights.double())
    assert ours.shape == shape and ours.device.type == device
    torch.testing.assert_close(ours.cpu().double(), twin, rtol=4e-7, atol=0.0)
    torch.testing.assert_close(ours_grad.cpu().double(), twin_grad, rtol=2e-6, atol=5e-7)  # 1 - sigmoid rounds


def test_the_whole_range_of_exponents(device):
    values = torch.linspace(-87.0, 88.7, 20_001)
    found = exponential(values.to(device)).cpu().double()
    torch.testing.assert_close(found, values.double().exp(), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize(
    ("value", "power", "share"),
    [
        (math.nan, math.nan, math.nan),
        (math.inf, math.inf, 1.0),
        (-math.inf, 0.0, 0.0),
        (89.0, math.inf, 1.0),
        (3e38, math.inf, 1.0),
        (-3e38, 0.0, 0.0),
        (-200.0, 0.0, 0.0),
        (0.0, 1.0, 0.5),
    ],
)
def test_extremes(value, power, share, device):
    one = torch.full((3,), value, device=device)
    assert exponential(one).tolist() == pytest.approx([power] * 3, nan_ok=True)
    assert sigmoid(one).tolist() == pytest.approx([share] * 3, nan_ok=True, abs=1e-30)


def test_rows_that_are_not_contiguous(device):
    values = torch.randn(40, 6, generator=torch.Generator().manual_seed(0)).to(device)
    torch.testing.assert_close(exponential(values[:, 1:3]), exponential(values)[:, 1:3], rtol=4e-7, atol=0)
    torch.testing.assert_close(sigmoid(values[:, -1:]), sigmoid(values)[:, -1:], rtol=4e-7, atol=0)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_same_bits_for_any_thread_count(function, all_threads):
    """Torch's own differ where its threads meet: 100,000 elements are cut at 50,000, which is no multiple of 32."""
    values = torch.randn(100_003, generator=torch.Generator().manual_seed(3))
    results = []
    for threads in (1, 2, 3, 5):
        environment.configure(threads=threads)
        results.append(function(values))
    assert all(torch.equal(results[0], other) for other in results[1:])
