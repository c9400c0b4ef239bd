"""Schedules, and rows of the optimiser that follow their Gaussians. ``tests/kernels/test_adam.py`` tests the steps."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from scgs_warp.optim import Adam, log_linear


class Owner(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.rows = nn.Parameter(torch.arange(8.0).view(4, 2))
        self.other = nn.Parameter(torch.ones(3))


def stepped() -> tuple[Owner, Adam]:
    owner = Owner()
    optimizer = Adam(dict(owner.named_parameters()), {"rows": 0.1, "other": 0.1})
    owner.rows.grad = torch.arange(1.0, 9.0).view(4, 2)
    optimizer.step()
    return owner, optimizer


def test_log_linear_is_straight_in_the_logarithm_and_then_constant():
    assert log_linear(1.0, 0.01, 0, 100) == 1.0
    assert log_linear(1.0, 0.01, 50, 100) == pytest.approx(0.1)
    assert log_linear(1.0, 0.01, 100, 100) == log_linear(1.0, 0.01, 5000, 100) == 0.01
    assert log_linear(0.0, 1.0, 25, 100) == 0.25
    assert log_linear(1.0, 0.5, 0, 0) == 0.5


def test_a_parameter_without_gradient_stays_without_state():
    owner, optimizer = stepped()
    assert [name for name, _ in optimizer.gradients()] == ["rows"]
    assert optimizer.groups["other"].exp_avg is None and optimizer.groups["other"].steps == 0
    assert torch.equal(owner.other, torch.ones(3))
    optimizer.zero_grad()
    assert optimizer.gradients() == []


def test_regather_keeps_moments_beside_their_rows():
    owner, optimizer = stepped()
    rows, group = owner.rows.detach().clone(), optimizer.groups["rows"]
    assert group.exp_avg is not None
    moments = group.exp_avg.clone()
    index, fresh = torch.tensor([3, 0, 0]), torch.tensor([False, False, True])
    optimizer.regather(owner, ("rows", "unknown"), index, fresh)
    assert owner.rows is group.parameter and torch.equal(owner.rows, rows[index])
    assert group.exp_avg is not None and group.exp_avg_sq is not None
    assert torch.equal(group.exp_avg[:2], moments[index[:2]]) and group.exp_avg_sq[:2].all()
    assert not group.exp_avg[2].any() and not group.exp_avg_sq[2].any()
    assert group.steps == 1


def test_reset_moments_keeps_the_step_count():
    _, optimizer = stepped()
    optimizer.reset_moments("rows")
    optimizer.reset_moments("other")
    group = optimizer.groups["rows"]
    assert group.exp_avg is not None and not group.exp_avg.any() and group.steps == 1


def test_tensors_come_back():
    _, optimizer = stepped()
    saved = {name: value.clone() for name, value in optimizer.tensors("a").items()}
    assert sorted(saved) == ["a.rows.exp_avg", "a.rows.exp_avg_sq", "a.rows.step"]
    fresh = Adam(dict(Owner().named_parameters()), {"rows": 0.1, "other": 0.1})
    fresh.load_tensors("a", saved)
    again = fresh.tensors("a")
    assert again.keys() == saved.keys() and all(torch.equal(again[k], saved[k]) for k in saved)


def test_bias_correction_counts_the_steps():
    """Adam by its definition, in float64: after three steps the averages are divided by 1 - beta^3."""
    owner = Owner()
    optimizer = Adam({"other": owner.other}, {"other": 0.1})
    value, first, second = 1.0, 0.0, 0.0
    for count, slope in enumerate((1.0, -3.0, 0.5), start=1):
        owner.other.grad = torch.full((3,), slope)
        optimizer.step()
        first, second = 0.9 * first + 0.1 * slope, 0.999 * second + 0.001 * slope**2
        value -= 0.1 * (first / (1 - 0.9**count)) / math.sqrt(second / (1 - 0.999**count))
        assert owner.other.tolist() == pytest.approx([value] * 3, rel=1e-5)
    assert optimizer.groups["other"].steps == 3
