"""Sweeps: frames and rasterisations over the number of Gaussians, pixels, control points and threads."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from ..errors import UserError
from ..runtime import environment
from ..runtime.provenance import provenance
from ..scene.scene import Scene
from .memory import resident_mib
from .plan import MIDDLE, BenchCase, BenchPlan, posed
from .roofline import Limits, Work, backward_work, draw_work, frame_work, measure_limits
from .scenes import LARGEST_SIDE, SMALLEST_SIDE, Load, load_of, scene_camera, synthetic_scene
from .workloads import frame_rows, raster_rows


def _thread_points() -> tuple[int, ...]:
    """Return 1, 2, 4 ... and all threads."""
    most = environment.available_threads()
    return tuple(sorted({*(2**k for k in range(most.bit_length()) if 2**k <= most), most}))


POINTS: dict[str, Callable[[], tuple[int, ...]]] = {
    "gaussians": lambda: (10_000, 20_000, 50_000, 100_000, 200_000, 500_000, 1_000_000, 2_000_000),
    "resolution": lambda: (200, 400, 800, 1200, 1600),
    "nodes": lambda: (64, 128, 256, 512, 1024, 2048, 4096),
    "threads": _thread_points,
}
"""Default points of every sweep."""


def parse_sweeps(text: str) -> dict[str, tuple[int, ...]]:
    """Parse names of sweeps, separated by commas, with optional points after a colon: ``"gaussians,nodes:64/128"``.

    Raises:
        UserError: a name or a number is wrong.
    """
    sweeps: dict[str, tuple[int, ...]] = {}
    for part in text.split(","):
        name, colon, points = (word.strip() for word in part.partition(":"))
        if name not in POINTS:
            raise UserError(f"--sweeps {text}: {name!r} is no sweep; choose from {','.join(POINTS)}")
        words = points.split("/")
        if colon and not all(word.isascii() and word.isdigit() for word in words):
            raise UserError(f"--sweeps {text}: {points!r} must be numbers with / between, such as {name}:64/128")
        sweeps[name] = tuple(sorted({int(word) for word in words})) if colon else POINTS[name]()
    return sweeps


@dataclass(frozen=True)
class Sweeps:
    """Quantities to vary around a plan of one motion model and one number of threads."""

    plan: BenchPlan
    points: dict[str, tuple[int, ...]]
    limits: dict[int, Limits] = field(default_factory=dict)

    def plans(self, name: str) -> list[tuple[int, BenchPlan]]:
        """Return the points of one sweep with their plans.

        Raises:
            UserError: a point cannot be measured.
        """
        changes: dict[str, Callable[[int], dict[str, Any]]] = {
            "gaussians": lambda point: {"gaussians": point},
            "resolution": lambda point: {"size": point},
            "nodes": lambda point: {"nodes": point},
            "threads": lambda point: {"threads": (point,)},
        }
        plans = [(point, replace(self.plan, **changes[name](point))) for point in self.points[name]]
        for point, plan in plans:
            self._check(name, point, plan)
        return plans

    def _check(self, name: str, point: int, plan: BenchPlan) -> None:
        least = _neighbors() + 1
        if not least <= plan.nodes <= plan.gaussians:
            raise UserError(
                f"--sweeps {name}:{point}: {plan.nodes} control points for {plan.gaussians} Gaussians; give at "
                f"least {least}, and no more than Gaussians"
            )
        if name == "resolution" and not SMALLEST_SIDE <= point <= LARGEST_SIDE:
            raise UserError(f"--sweeps {name}:{point}: give {SMALLEST_SIDE} to {LARGEST_SIDE} pixels")
        if not 1 <= plan.threads[0] <= 4096:
            raise UserError(f"--sweeps {name}:{point}: give at least one thread")

    def measure_limits(self, threads: int) -> None:
        """Measure a CPU's limits again and keep the best. This is called at every point, so that a single disturbance
        does not lower them."""
        if self.plan.device == "cpu":
            best = self.limits.get(threads, Limits(threads, 0.0, 0.0))
            now = measure_limits(threads)
            values = max(best.gigabytes, now.gigabytes), max(best.gigaflops, now.gigaflops)
            self.limits[threads] = Limits(threads, *values)


def _neighbors() -> int:
    from ..config.presets import MotionConfig

    return MotionConfig().neighbors


def scaling(plan: BenchPlan, points: dict[str, tuple[int, ...]]) -> dict[str, Any]:
    """Measure all sweeps.

    Args:
        plan: Quantities that a sweep does not vary, of which the first motion model and the last number of threads are
            used.
        points: Values by sweep.

    Returns:
        ``date``, ``commit``, ``machine``, ``what``, ``base``, ``limits`` (per number of threads) and ``sweeps``: per
        name a list of ``point``, ``rows`` (with ``KEYS``), ``work`` (bytes and flops by whole and stage) and
        ``limits``, the least milliseconds by row name (None on a GPU). Ready for JSON.

    Raises:
        UserError: a point cannot be measured.
    """
    sweeps = Sweeps(replace(plan, motions=plan.motions[:1], threads=plan.threads[-1:]), points)
    todo = [(name, *pair) for name in points for pair in sweeps.plans(name)]
    clock = _Clock([_weight(one) for _, _, one in todo])
    measured: dict[str, list[dict[str, Any]]] = {name: [] for name in points}
    before = environment.thread_count()
    try:
        for name, point, one in todo:
            plan.report(f"{name} {point:,}: {clock.left()}")
            measured[name].append({"point": point, **_measure(one, sweeps)})
            clock.done()
    finally:
        environment.configure(before)
    for entry in (entry for entries in measured.values() for entry in entries):
        limit = sweeps.limits.get(entry["rows"][0]["threads"])
        entry["limits"] = None if limit is None else least_times(limit, entry["work"])
    base = {"gaussians": plan.gaussians, "nodes": plan.nodes, "threads": sweeps.plan.threads[0]}
    limits = {str(threads): limit._asdict() for threads, limit in sorted(sweeps.limits.items())}
    head = {**provenance(plan.device), "what": "scaling", "base": base}
    return {**head, "limits": limits, "sweeps": measured}


def _measure(plan: BenchPlan, sweeps: Sweeps) -> dict[str, Any]:
    """Measure frames with their stages, and a rasterisation with gradients, of one synthetic scene."""
    threads = plan.threads[0]
    sweeps.measure_limits(threads)
    environment.configure(threads)
    scene = synthetic_scene(plan.motions[0], plan.gaussians, plan.nodes, plan.device)
    resident = resident_mib(plan.device)
    load = load_of(*posed(scene, plan.size, MIDDLE))
    case = BenchCase(scene, replace(plan, report=lambda text: None), load, threads, resident)
    rows = frame_rows(case) + raster_rows(case, forward=False)
    return {"rows": rows, "work": work_of(scene, load, plan)}


def work_of(scene: Scene, load: Load, plan: BenchPlan) -> dict[str, dict[str, dict[str, float]]]:
    """Count bytes and flops by whole and stage."""
    camera = scene_camera(scene, plan.size)
    size = camera.width, camera.height
    raster = draw_work(scene.gaussian_count, load, *size, 3)
    raster["backward"] = backward_work(scene.gaussian_count, load, *size)
    works = {"frame": frame_work(scene, load, *size), "raster/both": raster}
    return {whole: {stage: work._asdict() for stage, work in stages.items()} for whole, stages in works.items()}


def least_times(limit: Limits, works: dict[str, dict[str, dict[str, float]]]) -> dict[str, float]:
    """Return the least milliseconds by row name.

    Stages run one after another, so the limit of a whole frame is the sum of its stages' limits.
    """
    limits = {}
    for whole, stages in works.items():
        times = {stage: limit.milliseconds(Work(**work)) for stage, work in stages.items()}
        limits[whole] = sum(times.values())
        limits.update({f"{whole}/{stage}": value for stage, value in times.items()})
    return limits


def _weight(plan: BenchPlan) -> float:
    """Estimate the time for a point, in arbitrary units: making the scene, warm-up, repeats of slow rows."""
    side = plan.size if isinstance(plan.size, int) else max(plan.size)
    return 2.0 + 2.0 * plan.seconds + (1.0 + plan.nodes / 1024) * plan.gaussians / 60_000 + (side / 1000) ** 2


class _Clock:
    """Estimate of the remaining time, from the time that the finished points took."""

    def __init__(self, weights: list[float]) -> None:
        self.weights, self.finished, self.began = weights, 0, time.perf_counter()

    def done(self) -> None:
        self.finished += 1

    def left(self) -> str:
        if not self.finished:
            return f"1 of {len(self.weights)}"
        done, rest = sum(self.weights[: self.finished]), sum(self.weights[self.finished :])
        seconds = (time.perf_counter() - self.began) * rest / done
        minutes = f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"
        return f"{self.finished + 1} of {len(self.weights)}, about {minutes} left"
