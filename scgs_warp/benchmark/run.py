"""Measure a frame, a rasterisation, a training step, an edit or a pull; rows state what they were measured on."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

from ..config.presets import MOTIONS
from ..errors import UserError
from ..runtime import environment
from ..runtime.provenance import provenance
from ..scene.scene import Scene
from ..storage.files import write_atomically
from ..storage.output_folders import make_parent
from .editing import edit_rows, pull_rows
from .gsplat import Peers
from .memory import resident_mib
from .plan import MIDDLE, BenchCase, BenchPlan, posed
from .scenes import load_of, synthetic_scene
from .summary import compare_frames, motion_costs
from .workloads import frame_rows, frames_of, raster_rows, step_rows

What = Literal["frame", "raster", "step", "edit", "pull"]
MEASURES = {"frame": frame_rows, "raster": raster_rows, "step": step_rows, "edit": edit_rows, "pull": pull_rows}


def thread_counts(threads: int | None, device: str) -> tuple[int, ...]:
    """Return the numbers of threads to measure with: ``threads``, if it is given, otherwise 1 and all available ones.

    On a GPU, where the CPU's threads hardly matter, only the present number is used.
    """
    if threads is not None or device == "cuda":
        return (environment.thread_count() if threads is None else threads,)
    return tuple(sorted({1, environment.available_threads()}))


def bench(what: What, plan: BenchPlan) -> dict[str, Any]:
    """Measure a plan.

    Returns:
        ``date``, ``commit``, ``machine``, ``what`` and ``rows``, dictionaries with ``KEYS``; for frames also
        ``motion``, the cost of moving the scene, and ``compared``, the comparison of several motion models. Ready for
        JSON.

    Raises:
        UserError: the run cannot be read, gsplat is asked for and not usable, the renderers disagree, or the poses of a
            scene with control points cannot be interpolated as asked.
    """
    measure = MEASURES[what]
    peers = Peers.find(plan) if plan.against else None
    rows: list[dict[str, Any]] = []
    compared: list[dict[str, Any]] = []
    drawn: dict[str, Callable[[int], None]] = {}
    played: dict[str, Any] | None = None
    before = environment.thread_count()
    try:
        for scene in scenes(plan, what):
            resident = resident_mib(plan.device)
            if plan.playback and scene.motion_name == "control-points":
                played = kept(scene)
            load = load_of(*posed(scene, plan.size, MIDDLE), scene.config.antialiased and what != "raster")
            for threads in plan.threads:
                environment.configure(threads)
                case = BenchCase(scene, plan, load, threads, resident)
                rows += measure(case) if peers is None else peers.rows(case)
            if what == "frame":
                drawn[scene.motion_name] = frames_of(scene, plan.size)
        for threads in plan.threads if len(drawn) > 1 else ():
            environment.configure(threads)
            plan.report(f"all in turns, {threads} threads")
            compared += compare_frames(drawn, threads, plan.seconds, plan.device)
    finally:
        environment.configure(before)
    report = {**provenance(plan.device), "what": what, "playback": played, "rows": rows}
    return {**report, "motion": motion_costs(rows, compared), "compared": compared} if what == "frame" else report


def kept(scene: Scene) -> dict[str, Any]:
    """Keep the poses of a scene with control points; return how many, how exact, and at what price.

    Raises:
        UserError: they cannot be interpolated well enough.
    """
    began = time.perf_counter()
    track = scene.motion.kept_poses if scene.prepare_playback() else None
    if track is None:
        raise UserError("--playback: this motion cannot be interpolated well enough; leave the option out")
    seconds = time.perf_counter() - began
    return {"intervals": track.intervals, "error": track.error, "mib": track.rows.nbytes / 2**20, "seconds": seconds}


def scenes(plan: BenchPlan, what: What) -> Iterator[Scene]:
    """Yield the run's scene, or a synthetic one for every motion model; for ``raster``, only a static scene."""
    if plan.run is not None:
        yield Scene.load(plan.run, device=plan.device)
        return
    for motion in plan.motions if what != "raster" else ("static",):
        yield synthetic_scene(motion, plan.gaussians, plan.nodes, plan.device)


def check_motions(text: str) -> tuple[str, ...]:
    """Parse a list of motion models, separated by commas.

    Raises:
        UserError: a name is not that of a motion model.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names or ("",):
        if name not in MOTIONS:
            raise UserError(f"--motion {text}: {name!r} is no motion model; choose from {','.join(MOTIONS)}")
    return names


def write(report: dict[str, Any], path: Path) -> None:
    """Write a report as JSON.

    Raises:
        UserError: the file cannot be written.
    """
    make_parent(path)
    write_atomically(path, (json.dumps(report, indent=2, allow_nan=False) + "\n").encode())
