"""Workloads: frames as a viewer draws them, steps as in training."""

from __future__ import annotations

import pytest
import torch

from scgs_warp.benchmark import plan as bench_plan
from scgs_warp.benchmark import run as bench
from scgs_warp.benchmark import scenes, workloads
from scgs_warp.benchmark import timing as bench_clock
from scgs_warp.config.presets import MOTIONS
from scgs_warp.rendering import render as render_module

pytestmark = pytest.mark.usefixtures("all_threads")


@pytest.mark.parametrize("motion", MOTIONS)
def test_frames_are_drawn_as_of_a_loaded_run_and_steps_as_in_training(motion):
    scene = scenes.synthetic_scene(motion, 60, 12, "cpu")
    assert not scene.motion.training
    assert scenes.training_state(scene, arap=False).motion.training
    plan = bench.BenchPlan(None, 60, 12, 32, (motion,), "cpu", (1,), 0.0)
    case = bench_plan.BenchCase(scene, plan, scenes.Load(1, 1.0), 1)
    names = [row["name"] for row in workloads.step_rows(case)]
    assert not scene.motion.training and ("step/network" in names) == (motion != "static")


def test_on_a_gpu_stages_are_those_of_a_frame_drawn_step_by_step(monkeypatch):
    """The whole is a recorded graph there; the steps that are timed instead draw the same picture."""
    scene = scenes.synthetic_scene("control-points", 120, 12, "cpu")
    plan = bench.BenchPlan(None, 120, 12, 48, ("control-points",), "cuda", (1,), 0.0)
    case = bench_plan.BenchCase(scene, plan, scenes.Load(1, 1.0), 1)
    given, drawn = {}, []
    monkeypatch.setattr(
        bench_plan.BenchCase, "rows", lambda self, *args, **options: given.update(options, args=args) or []
    )
    workloads.frame_rows(case)
    draw = render_module.render
    monkeypatch.setattr(render_module, "render", lambda *args, **kw: drawn.append(draw(*args, **kw)) or drawn[-1])
    given["staged"](3)
    whole = scene.render(scenes.scene_camera(scene, 48), 0.5 + 0.4 * ((0.37 * 3) % 1.0 - 0.5))
    assert len(drawn) == 1 and torch.equal(drawn[0].rgb, whole.rgb) and torch.equal(drawn[0].depth, whole.depth)
    assert "bin" in bench_clock.Stages("cpu", given["args"][2]).repeat(given["staged"], 0.0)
