"""Outcome and update of a recorded step against float64 and against the form that the host decides."""

from __future__ import annotations

import math

import pytest
import torch

from scgs_warp.kernels.types import STEP_FINE, STEP_GRADIENT, STEP_HALTED, STEP_LOSS, STEP_REGULARISER
from scgs_warp.ops.adam import Update, adam_step
from scgs_warp.ops.step_outcome import Moments, StepOutcome, UpdateTable

BETAS, EPS = (0.9, 0.999), 1e-15
BAD = [math.nan, math.inf, -math.inf]


def scalar(value: float, device: str) -> torch.Tensor:
    return torch.tensor(value, device=device)


def judged(outcome: StepOutcome, pairs: int, room: int, loss: float, regulariser: float | None) -> int:
    device = str(outcome.value.device)
    term = None if regulariser is None else scalar(regulariser, device)
    outcome.judge_loss(torch.tensor([pairs], device=device), room, scalar(loss, device), term)
    return int(outcome.value)


@pytest.mark.parametrize("bad", BAD)
def test_outcomes_of_a_loss(bad, device):
    outcome = StepOutcome(torch.device(device))
    assert judged(outcome, 7, 7, 0.5, 0.1) == judged(outcome, 0, 1, 0.5, None) == STEP_FINE
    assert judged(outcome, 7, 9, 0.5, bad) == STEP_REGULARISER
    assert judged(outcome, 7, 9, bad, 0.1) == judged(outcome, 7, 9, bad, bad) == STEP_LOSS
    assert not outcome.halted.any()


def test_a_step_without_room_halts_all_that_follow(device):
    outcome = StepOutcome(torch.device(device))
    assert judged(outcome, 2**33, 2**31, math.nan, 0.1) == STEP_HALTED
    assert judged(outcome, 1, 9, 0.5, 0.1) == STEP_HALTED
    outcome.halted.zero_()
    assert judged(outcome, 1, 9, 0.5, 0.1) == STEP_FINE


SIZES = (1, 4095, 4096, 4097, 0, 9000)


def moments_of(device: str, seed: int = 0) -> list[Moments]:
    random = torch.Generator().manual_seed(seed)
    made = [Moments(*(torch.randn(size, generator=random).to(device) for _ in range(4))) for size in SIZES]
    for moments in made:
        moments.exp_avg_sq.abs_()
    return made


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("at", [(0, 0), (1, 4094), (2, 4095), (3, 4096), (5, 0), (5, 8999)])
def test_the_first_gradient_that_is_not_finite(at, bad, device):
    outcome, made = StepOutcome(torch.device(device)), moments_of(device)
    table = UpdateTable([moments.gradient for moments in made], [], torch.device(device))
    assert judged(outcome, 1, 2, 0.5, None) == STEP_FINE
    table.judge_gradients(outcome)
    assert int(outcome.value) == STEP_FINE
    made[5].gradient[17] = math.nan
    made[at[0]].gradient[at[1]] = bad
    table.judge_gradients(outcome)
    assert int(outcome.value) == STEP_GRADIENT + at[0]
    assert judged(outcome, 1, 2, math.nan, None) == STEP_LOSS
    table.judge_gradients(outcome)
    assert int(outcome.value) == STEP_LOSS, "the loss comes first"


def test_steps_and_their_counts(device):
    """Twelve steps, three of them dropped: those of ``adam_step`` to the bit, and of float64 within rounding."""
    made, expected, slow = (moments_of(device) for _ in range(3))
    slow = [Moments(*(tensor.double() for tensor in moments)) for moments in slow]
    rows, steps = [4, 0, 3, 1, 2, 5], [9, 0, 499, 3, 80_000, 1]
    outcome = StepOutcome(torch.device(device))
    table = UpdateTable([], list(zip(rows, made)), torch.device(device))
    counts = torch.zeros(6, dtype=torch.int32)
    counts[torch.tensor(rows)] = torch.tensor(steps, dtype=torch.int32)
    counts = counts.to(device)
    for step in range(12):
        rates = torch.linspace(1e-4, 0.03, 6, dtype=torch.float64) / (1 + step)
        dropped = step in (0, 5, 6)
        assert judged(outcome, 1, 2, math.nan if dropped else 0.5, None) == (STEP_LOSS if dropped else STEP_FINE)
        table.adam_step(outcome, rates.to(device), counts, BETAS, EPS)
        if dropped:
            continue
        steps = [count + 1 for count in steps]
        own = [float(rates[row]) for row in rows]
        updates = [Update(*moments, rate, count) for moments, rate, count in zip(expected, own, steps)]
        adam_step(updates, betas=BETAS, eps=EPS, form="plain")
        for (value, gradient, average, square), rate, count in zip(slow, own, steps):
            average += 0.1 * (gradient - average)
            square *= 0.999
            square += 0.001 * gradient**2
            value -= rate / (1 - 0.9**count) * average / ((square / (1 - 0.999**count)).sqrt() + EPS)
    assert counts[torch.tensor(rows)].tolist() == steps
    for ours, theirs, exact in zip(made, expected, slow):
        for index, (a, b, c) in enumerate(zip(ours, theirs, exact)):
            assert torch.equal(a, b)
            torch.testing.assert_close(a.double(), c, rtol=2e-5, atol=2e-6 if index else 2e-5)


@pytest.mark.parametrize("regulariser", [None, 0.25])
def test_report(regulariser, device):
    outcome = StepOutcome(torch.device(device))
    judged(outcome, 2**40, 2**41, 0.5, None)
    term = None if regulariser is None else scalar(regulariser, device)
    scalars = [scalar(value, device) for value in (0.5, -1.5, 0.75)]
    found = outcome.report(torch.tensor([2**40], device=device), *scalars, term, scalar(0.125, device))
    assert found.tolist() == [STEP_FINE, 2**40, 0.5, -1.5, 0.75, regulariser or 0.0, 0.125]
