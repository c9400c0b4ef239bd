"""Memory of a benchmark."""

from __future__ import annotations

import pytest
import torch

from scgs_warp.benchmark import memory, scenes
from scgs_warp.benchmark import plan as bench_plan
from scgs_warp.benchmark import run as bench

pytestmark = pytest.mark.usefixtures("all_threads")


@pytest.mark.skipif(memory.resident_mib("cpu") is None, reason="the system does not say what is resident")
def test_extra_memory_is_what_measuring_takes():
    """A call that holds 64 MiB, then one that holds nothing: the peak counts anew for each row."""
    scene = scenes.synthetic_scene("static", 120, 12, "cpu")
    plan = bench.BenchPlan(None, 120, 12, 48, ("static",), "cpu", (1,), 0.0)
    before = memory.resident_mib("cpu")
    case = bench_plan.BenchCase(scene, plan, scenes.Load(1, 1.0), 1, before)
    held, idle = (
        case.rows("x", function, {})[0] for function in (lambda i: torch.ones(16, 2**20).sum(), lambda i: None)
    )
    if idle["peak_mib"] > held["peak_mib"] - 32:
        pytest.skip("the peak cannot be reset here")
    assert 60 < held["extra_mib"] < 100 and idle["extra_mib"] < 20
    assert held["model_mib"] == pytest.approx(120 * 4 * (3 + 4 + 3 + 1 + 48) / 2**20)
    assert memory.extra_mib(None, 1.0) is None and memory.extra_mib(1.0, None) is None
