"""Parts of ``gpu_check`` that time this project alone: frames, training steps, forms of compositing, stages."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from gpu_agreement import SHARPNESS, compare, drawn, leaves_of, stepwise
from gpu_rules import FRAMES_A_SECOND, MOTION_MS, alternate, at_least, at_most, time_of, wait
from gpu_session import Call, Report, Setting
from torch import Tensor

import scgs_warp
from scgs_warp.benchmark.plan import BenchPlan
from scgs_warp.benchmark.run import bench
from scgs_warp.benchmark.scenes import scene_camera, synthetic_scene, training_data, training_state
from scgs_warp.benchmark.summary import table_s2
from scgs_warp.benchmark.workloads import Leaves
from scgs_warp.config.presets import MOTIONS
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.binning_cuda import bin_within
from scgs_warp.ops.compositing import composite
from scgs_warp.ops.harmonics import spherical_harmonics
from scgs_warp.ops.projection import project
from scgs_warp.ops.ssim import photometric_loss
from scgs_warp.runtime import environment
from scgs_warp.runtime.cuda_graph import CudaGraph
from scgs_warp.scene.frame_graph import FrameGraph
from scgs_warp.scene.scene import Scene
from scgs_warp.training.frames import Frames
from scgs_warp.training.recorded_step import RecordedSteps
from scgs_warp.training.stepping import PlainSteps, steps_of
from scgs_warp.types import Camera, Splats

SLOWEST_FORM = 50_000
"""Largest number of Gaussians for which the slow forms of compositing are timed."""
BLOCK, QUICK_BLOCK = 10, 2
"""Number of training steps of one kind in a row."""


def met(report: Report, s: Setting) -> bool:
    """Return whether all goals are met, as far as they are judged."""
    return not s.judged or all(goal["met"] for goal in report["goals"].values())


def frame(call: Call) -> Report:
    """Time frames of the moving scene with every motion model.

    The result has frames per second, the share of the time that motion takes, and the relative speeds of Table S2.
    """
    s = call.setting
    rows = [frame_row(name, s) for name in MOTIONS]
    for row in rows:
        row["ratios"] = {peer["motion"]: row["fps"] / peer["fps"] for peer in rows}
    moving = next(row for row in rows if row["motion"] == "control-points")
    goals = {
        "frames a second": at_least(moving["fps"], FRAMES_A_SECOND),
        "motion, ms": at_most(moving["motion_ms"], MOTION_MS),
    }
    share = moving["motion_ms"] * moving["fps"] / 1e3
    report: Report = {"rows": rows, "table_s2": table_s2(rows), "motion_share": share, "goals": goals}
    return {**report, "passed": met(report, s)}


def frame_row(motion: str, s: Setting) -> Report:
    count, size = next(iter(s.scenes.values()))
    scene = synthetic_scene(motion, count, s.nodes, s.device)
    camera, repeats, numbers = scene_camera(scene, size), 5 * s.repeats, itertools.count()
    row: Report = {"name": "frame", "motion": motion, "threads": environment.thread_count()}
    row.update(time_of(lambda: scene.render(camera, (0.37 * next(numbers)) % 1.0), s.device, repeats))
    row["motion_ms"] = motion_ms(scene, s.device, s.repeats)
    row["step_by_step"] = time_of(lambda: stepwise(scene, camera, 0.3), s.device, s.repeats)
    best = row["ms_in_a_row"]
    if scene.motion.takes_time_tensor:
        graph = scene.frame_graph()
        row["ms_two_under_way"] = two_under_way(graph, scene, camera, repeats)
        best = min(best, row["ms_two_under_way"])
        row.update(failure=graph.failure, capacity=graph.capacity)
    return {**row, "fps": 1e3 / best}


def motion_ms(scene: Scene, device: str, repeats: int) -> float:
    """Return the milliseconds for posing all Gaussians, from a recorded graph if possible."""
    at = torch.full((1,), 0.4, device=scene.device)

    @torch.no_grad()
    def pose() -> Any:
        return scene.motion.gaussians_at(scene.gaussians, at if scene.motion.takes_time_tensor else 0.4)

    recorded = device == "cuda" and scene.motion.takes_time_tensor
    call = CudaGraph(pose, scene.device).replay if recorded else pose
    return time_of(call, device, repeats)["ms_in_a_row"]


def two_under_way(graph: FrameGraph, scene: Scene, camera: Camera, repeats: int) -> float:
    """Return milliseconds per frame if each frame is submitted before the previous one is finished."""
    view, color = scene.normalisation.apply_camera(camera), torch.tensor(scene.background_color)
    start, last = time.perf_counter(), graph.submit(view, 0.1, color)
    for index in range(repeats):
        following = graph.submit(view, (0.37 * index) % 1.0, color)
        graph.finish(last)
        last = following
    graph.finish(last)
    return 1e3 * (time.perf_counter() - start) / (repeats + 1)


def step(call: Call) -> Report:
    """Time training steps at half the size, with and without ARAP: recorded ones beside plain ones, and the stages."""
    s = call.setting
    count, size = next(iter(s.scenes.values()))
    half, count = (size[0] // 2, size[1] // 2), min(count, 40_000)
    in_turns = {name: steps_in_turns(arap, count, half, s) for name, arap in (("step", False), ("step/arap", True))}
    threads = (environment.thread_count(),)
    plan = BenchPlan(None, count, s.nodes, half, ("control-points",), s.device, threads, s.seconds)
    passed = all(row.get("failure") is None and row.get("recordings", 1) > 0 for row in in_turns.values())
    return {"in_turns": in_turns, "rows": bench("step", plan)["rows"], "passed": passed}


def steps_in_turns(arap: bool, count: int, size: tuple[int, int], s: Setting) -> Report:
    """Time blocks of recorded and of plain steps of two equal runs, in turns.

    The host waits at the end of a block alone, as in training.
    """
    runs: dict[str, Callable[[], None]] = {}
    block = QUICK_BLOCK if s.quick else BLOCK
    taken: dict[str, Any] = {}
    for name in ("recorded", "plain"):
        scene = synthetic_scene("control-points", count, s.nodes, s.device)
        scene.motion.cache_binding(None)
        data, state = training_data(scene, size), training_state(scene, arap)
        frames = Frames(data, scene.normalisation, state.config, s.device)
        taken[name] = steps_of(state, frames) if name == "recorded" else PlainSteps(state, frames)

        def advance(state=state, steps=taken[name]) -> None:
            for _ in range(block):
                steps.take()
                state.step += 1
            steps.settle()

        runs[name] = advance
    times = alternate(runs, s.device, s.repeats)
    report: Report = {name: {key: ms / block for key, ms in own.items()} for name, own in times.items()}
    report["ratio"] = report["plain"]["ms_median"] / report["recorded"]["ms_median"]
    if isinstance(steps := taken["recorded"], RecordedSteps):
        report.update(recordings=steps.recordings, repeats=steps.repeats, failure=steps.failure)
    return report


def forms(call: Call) -> Report:
    """Compare every form of compositing on the device with the readable plain form, and time it."""
    s = call.setting
    names = ("cuda", "blocks") if s.device == "cuda" else ("cpu",)
    report: Report = {"passed": True}
    for scene, (count, size) in s.scenes.items():
        leaves = leaves_of(count, size, s.device)
        for form in names if count <= SLOWEST_FORM else names[:1]:
            report[f"{scene}/{form}"] = form_times(leaves, form, s)
        if count > SLOWEST_FORM:
            continue
        for sharpness in (0.0, SHARPNESS):
            truth = drawn(leaves, "plain", sharpness)
            for form in names:
                row = compare(drawn(leaves, form, sharpness), truth, list(leaves.gaussians.tensors()))
                report[f"{scene}/{form}"].update({"sharp": row} if sharpness else row)
                report["passed"] = report["passed"] and row["passed"]
    return report


def form_times(leaves: Leaves, form: str, s: Setting) -> Report:
    """Time the compositing of three channels alone, without projection and binning."""
    own, camera = leaves.gaussians, leaves.camera
    with torch.no_grad():
        splats = project(*leaves.geometry, camera.viewmat, camera.K, camera.width, camera.height)
        colors = spherical_harmonics(own.sh_dc, own.sh_rest, own.means, camera.position, leaves.degree)
        tiles = bin_splats(splats)
    inputs = [x.detach().requires_grad_() for x in (splats.means2d, splats.conics, splats.opacities, colors)]
    held = replace(splats, means2d=inputs[0], conics=inputs[1], opacities=inputs[2])

    def image() -> Tensor:
        return composite(held, inputs[3], tiles, form=form)[0]  # type: ignore[arg-type]

    both = time_of(lambda: torch.autograd.grad(image(), inputs, leaves.v_image), s.device, s.repeats)
    with torch.no_grad():
        return {"pairs": len(tiles.splats), "forward": time_of(image, s.device, s.repeats), "both": both}


def raster_calls(leaves: Leaves, rasterization: Callable[..., Any]) -> dict[str, Callable[[], Any]]:
    """Return the calls to time for a renderer: ``forward``, and ``both`` with the gradients."""

    def forward() -> None:
        with torch.no_grad():
            leaves.rasterize(rasterization)

    def both() -> None:
        torch.autograd.grad(leaves.rasterize(rasterization), (*leaves.geometry, leaves.harmonics), leaves.v_image)

    return {"forward": forward, "both": both}


def raster(call: Call) -> Report:
    """Time ``rasterization`` as a whole, and its forward stages one by one."""
    s = call.setting
    report: Report = {}
    for name, (count, size) in s.scenes.items():
        leaves = leaves_of(count, size, s.device)
        calls = raster_calls(leaves, scgs_warp.rasterization)
        whole = {key: time_of(one, s.device, s.repeats) for key, one in calls.items()}
        report[name] = {"gaussians": count, "size": size, **whole, **stage_times(leaves, s)}
        wait(s.device)
    return {**report, "passed": True}


@torch.no_grad()
def stage_times(leaves: Leaves, s: Setting) -> Report:
    own, camera = leaves.gaussians, leaves.camera

    def projected() -> Splats:
        return project(*leaves.geometry, camera.viewmat, camera.K, camera.width, camera.height)

    def colored() -> Tensor:
        return spherical_harmonics(own.sh_dc, own.sh_rest, own.means, camera.position, leaves.degree)

    splats, colors = projected(), colored()
    tiles = bin_splats(splats)
    image, room = composite(splats, colors, tiles)[0], max(1, len(tiles.splats))
    stages: dict[str, Callable[[], Any]] = {
        "project": projected,
        "harmonics": colored,
        "bin": lambda: bin_splats(splats),
        "bin_within": lambda: bin_within(splats, room, slots=False),
        "composite": lambda: composite(splats, colors, tiles),
        "photometric_loss": lambda: photometric_loss(image, leaves.v_image),
    }
    times = {stage: time_of(one, s.device, s.repeats) for stage, one in stages.items()}
    return {"pairs": len(tiles.splats), "stages": times}
