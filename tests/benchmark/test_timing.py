"""Timing: repeats under a budget, and stages of the code in use."""

from __future__ import annotations

import types

import pytest
import torch

from helpers.bench_rows import TINY, rows_of
from scgs_warp.benchmark import run as bench
from scgs_warp.benchmark import timing as bench_clock
from scgs_warp.benchmark import workloads
from scgs_warp.rendering import render as render_module
from scgs_warp.training import view as training_view

pytestmark = pytest.mark.usefixtures("all_threads")


def test_stages_unwrap_what_they_wrap_and_count_nested_ones_once():
    def busy(rounds: int) -> float:
        return sum(k**0.5 for k in range(rounds))

    owner = types.SimpleNamespace(inner=lambda: busy(20_000))
    owner.outer = lambda: (busy(20_000), owner.inner())
    before = dict(vars(owner))
    stages = bench_clock.Stages("cpu", {"outer": [(owner, "outer")], "inner": [(owner, "inner")]})
    for _ in range(3):  # another process may take the core in one of them
        found = stages.repeat(lambda index: (owner.outer(), busy(40_000)), 0.0)
        assert set(found) == {"outer", "rest"} and vars(owner) == before
        if 0.2 < found["outer"][1] < 0.8:
            break
    assert 0.2 < found["outer"][1] < 0.8
    with pytest.raises(ZeroDivisionError):
        stages.repeat(lambda index: 1 / 0, 0.0)
    assert vars(owner) == before


def test_nothing_stays_wrapped(tmp_path):
    names = [
        (render_module, "project"),
        (training_view, "photometric_loss"),
        (torch.Tensor, "backward"),
        (workloads, "project"),
    ]
    before = [getattr(*place) for place in names]
    rows_of(tmp_path, "step", *TINY)
    assert [getattr(*place) for place in names] == before


def test_warm_up_is_left_out_and_time_bounds_the_repeats():
    calls: list[int] = []
    timing = bench_clock.repeat(calls.append, 0.0, "cpu")
    assert calls == list(range(bench_clock.WARM_UP + bench_clock.MIN_REPEATS)) and 0 <= timing.least <= timing.median


def test_two_threads_scaling_leaves_the_thread_count_alone():
    bench.environment.configure(1)
    assert 0.3 < bench_clock.two_thread_scaling() < 3.0
    assert bench.environment.thread_count() == 1
