"""Plan of a benchmark, and the measurement of its rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from ..scene.scene import Scene
from ..types import Camera, Gaussians
from .memory import extra_mib, model_mib, peak_mib, reset_peak
from .scenes import Load, Size, scene_camera
from .timing import Stages, repeat, two_thread_scaling

KEYS = (
    *("name", "renderer", "device", "motion", "gaussians", "control_points", "width", "height", "threads"),
    *("pairs", "contributors", "covered", "ms_median", "ms_min", "fps", "share"),
    *("model_mib", "peak_mib", "extra_mib", "two_thread_scaling"),
)
"""Keys of every row. ``fps`` is None for a stage; ``share``, a stage's part of the whole, is None for a whole."""
MIDDLE = 0.5
"""Scene time at which the load is counted and a rasterisation is measured."""


@dataclass(frozen=True)
class BenchPlan:
    """Checked options of a benchmark."""

    run: Path | None
    gaussians: int
    nodes: int
    size: Size
    motions: tuple[str, ...]
    device: str
    threads: tuple[int, ...]
    seconds: float
    against: str | None = None
    playback: bool = False
    """Whether poses are kept and interpolated (``Scene.prepare_playback``)."""
    report: Callable[[str], None] = field(default=lambda text: None)


@torch.no_grad()
def posed(scene: Scene, size: Size, time: float) -> tuple[Gaussians, Camera]:
    """Return the Gaussians at ``time`` and the camera, both in world units."""
    return scene.gaussians_at(time), scene_camera(scene, size)


@dataclass(frozen=True)
class BenchCase:
    """One scene on one number of threads."""

    scene: Scene
    plan: BenchPlan
    load: Load
    threads: int
    before_mib: float | None = None
    """Memory in use after the scene was loaded and before the first frame."""

    def rows(
        self,
        name: str,
        function: Callable[[int], Any],
        targets: dict[str, list[tuple[Any, str]]],
        renderer: str = "scgs_warp",
        staged: Callable[[int], Any] | None = None,
    ) -> list[dict[str, Any]]:
        """Time calls of ``function`` as a whole, then the stages ``targets`` in separate calls.

        The stages are timed in calls of ``staged`` instead, if it is given.
        """
        plan, device = self.plan, self.plan.device
        plan.report(f"{name}, {self.scene.motion_name}, {self.threads} threads")
        scaling = two_thread_scaling()
        reset_peak(device)
        whole = repeat(function, plan.seconds, device)
        parts = Stages(device, targets).repeat(staged or function, plan.seconds) if targets else {}
        camera = scene_camera(self.scene, plan.size)
        peak = peak_mib(device)
        common = {
            "renderer": renderer,
            "device": device,
            "motion": self.scene.motion_name,
            "gaussians": self.scene.gaussian_count,
            "control_points": self.scene.control_point_count,
            "width": camera.width,
            "height": camera.height,
            "threads": self.threads,
            "pairs": self.load.pairs,
            "contributors": self.load.contributors,
            "covered": self.load.covered,
            "model_mib": model_mib(self.scene),
            "peak_mib": peak,
            "extra_mib": extra_mib(peak, self.before_mib),
            "two_thread_scaling": scaling,
        }
        timed = [(name, whole, 1e3 / whole.median, None)]
        timed += [(f"{name}/{stage}", timing, None, share) for stage, (timing, share) in parts.items()]
        rows = []
        for label, timing, fps, share in timed:
            figures = {"ms_median": timing.median, "ms_min": timing.least, "fps": fps, "share": share}
            values = {"name": label, **common, **figures}
            rows.append({key: values[key] for key in KEYS})
        return rows
