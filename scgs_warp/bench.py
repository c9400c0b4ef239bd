"""What a frame, a rasterisation and a training step cost, as rows that state what they were measured on."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from . import environment, rasterize, render, train
from .bench_clock import Stages, machine, now, peak_mib, repeat, reset_peak, two_thread_scaling
from .bench_scene import Load, load_of, scene_camera, synthetic_scene, training_data, training_state
from .config import MOTIONS
from .errors import UserError
from .frames import Frames
from .motion import ControlPoints, HexPlane, PerGaussian, control_points
from .motion.base import Motion
from .ops.binning import bin_splats
from .ops.compositing import composite
from .ops.harmonics import spherical_harmonics
from .ops.projection import project
from .optim import generator
from .scene import Scene
from .types import Camera, Gaussians

KEYS = (
    *("name", "renderer", "device", "motion", "gaussians", "control_points", "width", "height", "threads"),
    *("pairs", "contributors", "ms_median", "ms_min", "fps", "share", "peak_mib", "two_thread_scaling"),
)
"""Of every row. ``fps`` is None for a stage, whose ``share`` is that of the whole; ``share`` is None for a whole."""
What = Literal["frame", "raster", "step"]
RENDER_STAGES = {
    "project": "project",
    "harmonics": "spherical_harmonics",
    "bin": "bin_splats",
    "composite": "composite",
}
MIDDLE = 0.5
"""The instant whose load is counted, and at which a rasterisation is measured."""
TOLERANCE = 1e-4
LARGEST = 8e-3
AGREEING = 0.999
"""The rule by which two renderers agree: this share of pixels within TOLERANCE, none beyond LARGEST."""


@dataclass(frozen=True)
class Plan:
    """What to measure, checked."""

    run: Path | None
    gaussians: int
    nodes: int
    size: int
    motions: tuple[str, ...]
    device: str
    threads: tuple[int, ...]
    seconds: float
    against: str | None = None
    report: Callable[[str], None] = field(default=lambda text: None)


def thread_counts(threads: int | None, device: str) -> tuple[int, ...]:
    """One thread and all of them, unless one number is asked for; on a GPU the CPU's threads hardly matter."""
    if threads is not None or device == "cuda":
        return (environment.thread_count() if threads is None else threads,)
    return tuple(sorted({1, environment.available_threads()}))


def bench(what: What, plan: Plan) -> dict[str, Any]:
    """Measure.

    Returns:
        ``date``, ``machine``, ``what`` and ``rows``, dictionaries with ``KEYS``; ready for JSON.

    Raises:
        UserError: the run cannot be read, gsplat is asked for and not usable, or the renderers disagree.
    """
    measure = {"frame": frame_rows, "raster": raster_rows, "step": step_rows}[what]
    peers = Peers.find(plan) if plan.against else None
    rows: list[dict[str, Any]] = []
    before = environment.thread_count()
    try:
        for scene in scenes(plan, what):
            load = load_of(*posed(scene, plan.size, MIDDLE), scene.config.antialiased and what != "raster")
            for threads in plan.threads:
                environment.configure(threads)
                place = Place(scene, plan, load, threads)
                rows += measure(place) if peers is None else peers.rows(place)
    finally:
        environment.configure(before)
    return {"date": now(), "machine": machine(plan.device), "what": what, "rows": rows}


def scenes(plan: Plan, what: What) -> Iterator[Scene]:
    """The run's scene, or a synthetic one for every motion model; a rasterisation knows no motion."""
    if plan.run is not None:
        yield Scene.load(plan.run, device=plan.device)
        return
    for motion in plan.motions if what != "raster" else ("static",):
        yield synthetic_scene(motion, plan.gaussians, plan.nodes, plan.device)


@torch.no_grad()
def posed(scene: Scene, size: int, time: float) -> tuple[Gaussians, Camera]:
    """Gaussians at ``time`` and the camera, both in world units."""
    return scene.gaussians_at(time), scene_camera(scene, size)


@dataclass(frozen=True)
class Place:
    """One scene on one number of threads, and how rows of it are made."""

    scene: Scene
    plan: Plan
    load: Load
    threads: int

    def rows(
        self,
        name: str,
        function: Callable[[int], Any],
        targets: dict[str, list[tuple[Any, str]]],
        renderer: str = "scgs_warp",
    ) -> list[dict[str, Any]]:
        """The whole, undisturbed, then its stages, in calls of their own."""
        plan, device = self.plan, self.plan.device
        plan.report(f"{name}, {self.scene.motion_name}, {self.threads} threads")
        scaling = two_thread_scaling()
        reset_peak(device)
        whole = repeat(function, plan.seconds, device)
        parts = Stages(device, targets).repeat(function, plan.seconds) if targets else {}
        camera = scene_camera(self.scene, plan.size)
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
            "peak_mib": peak_mib(device),
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


def motion_stages(motion: Motion, training: bool = False) -> dict[str, list[tuple[Any, str]]]:
    """Where a motion model spends its time: the network (planes and their heads included), and skinning (which in
    training includes the search for neighbours)."""
    if isinstance(motion, ControlPoints):
        found: dict[str, list[tuple[Any, str]]] = {"network": [(motion, "poses")]}
        found["skin"] = [(motion, "bind_and_pose"), (motion, "apply_pose")]
        if training:
            found["arap"] = [(motion, "refresh_graph"), (control_points, "rigidity")]
        return found
    if isinstance(motion, PerGaussian):
        return {"network": [(motion.network, "forward")]}
    return {"network": [(motion, "gaussians_at")]} if isinstance(motion, HexPlane) else {}


def draw_stages(module: Any) -> dict[str, list[tuple[Any, str]]]:
    return {stage: [(module, name)] for stage, name in RENDER_STAGES.items()}


def frame_rows(place: Place) -> list[dict[str, Any]]:
    """Frames of the moving scene: each at another time, so that the network runs for each; neighbours are cached."""
    scene = place.scene
    camera = scene_camera(scene, place.plan.size)
    targets = {**motion_stages(scene.motion), **draw_stages(render)}
    return place.rows("frame", lambda index: scene.render(camera, 0.5 + 0.4 * ((0.37 * index) % 1.0 - 0.5)), targets)


class Leaves:
    """Gaussians as the tensors that gradients are asked for, and one gradient of an image."""

    def __init__(self, gaussians: Gaussians, camera: Camera) -> None:
        def leaf(value: Tensor) -> Tensor:
            return value.detach().clone().requires_grad_()

        self.camera = camera
        self.gaussians = Gaussians(**{name: leaf(value) for name, value in vars(gaussians).items()})
        self.harmonics = leaf(torch.cat([gaussians.sh_dc[:, None], gaussians.sh_rest], dim=1))
        self.degree = round(self.harmonics.shape[1] ** 0.5) - 1
        self.v_image = torch.rand(3, camera.height, camera.width, generator=generator(0, 4)).to(self.harmonics.device)

    @property
    def geometry(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        own = self.gaussians
        return own.means, own.quats, own.scales, own.opacities

    def draw(self) -> Tensor:
        """[3, H, W] by the project's own stages."""
        own, camera = self.gaussians, self.camera
        splats = project(*self.geometry, camera.viewmat, camera.K, camera.width, camera.height)
        colors = spherical_harmonics(own.sh_dc, own.sh_rest, own.means, camera.position, self.degree)
        return composite(splats, colors, bin_splats(splats))[0]

    def rasterize(self, rasterization: Callable[..., Any]) -> Tensor:
        """[3, H, W] through the entry point that gsplat and this project share."""
        camera = self.camera
        views = camera.viewmat[None], camera.K[None], camera.width, camera.height
        image = rasterization(*self.geometry, self.harmonics, *views, sh_degree=self.degree, packed=False)[0]
        return image[0].permute(2, 0, 1)


def raster_rows(place: Place) -> list[dict[str, Any]]:
    """Projection, harmonics, binning and compositing of three channels: forward, and forward with all gradients."""
    leaves = Leaves(*posed(place.scene, place.plan.size, MIDDLE))
    module = _this_module()

    def forward(index: int) -> None:
        with torch.no_grad():
            leaves.draw()

    def both(index: int) -> None:
        torch.autograd.grad(leaves.draw(), tuple(vars(leaves.gaussians).values()), leaves.v_image)

    backward = {"backward": [(torch.autograd, "grad")]}
    rows = place.rows("raster/forward", forward, draw_stages(module))
    return rows + place.rows("raster/both", both, {**draw_stages(module), **backward})


def _this_module() -> Any:
    return sys.modules[__name__]


def step_rows(place: Place) -> list[dict[str, Any]]:
    """A training step in the joint phase, on images of the scene itself; with the ARAP term where there is one."""
    scene = place.scene
    data = training_data(scene, place.plan.size)
    rows = []
    for name, arap in (("step", False), ("step/arap", True)):
        if arap and not isinstance(scene.motion, ControlPoints):
            continue
        cache = getattr(scene.motion, "cache_binding", None)
        if cache is not None:
            cache(None)
        state = training_state(scene, arap)
        frames = Frames(data, scene.normalisation, state.config, place.plan.device)
        targets = {
            **motion_stages(scene.motion, training=True),
            **draw_stages(render),
            "loss": [(train, "photometric_loss")],
            "backward": [(torch.Tensor, "backward")],
            "adam": [(one, "step") for one in (state.gaussian_optimizer, state.motion_optimizer) if one is not None],
        }

        def step(index: int, state: Any = state, frames: Frames = frames) -> None:
            if train.training_step(state, frames).failed is not None:
                raise UserError(
                    f"step: the loss of {scene.motion_name} is not finite; measure another scene with --run"
                )
            state.step += 1

        rows += place.rows(name, step, targets)
    scene.freeze_binding()
    return rows


class Peers:
    """gsplat beside this project: the same Gaussians and camera through the same entry point."""

    def __init__(self, rasterization: Callable[..., Any]) -> None:
        self.rasterization = rasterization

    @staticmethod
    def find(plan: Plan) -> Peers:
        """
        Raises:
            UserError: gsplat is not installed, or there is no GPU, without which it does not composite.
        """
        if plan.device != "cuda":
            raise UserError(
                "--against gsplat: gsplat composites on CUDA only; use a machine with a GPU, or leave it out"
            )
        try:
            import gsplat
        except ImportError as error:
            raise UserError(f"--against gsplat: it cannot be imported ({error}); pip install gsplat==1.5.3") from error
        return Peers(gsplat.rasterization)

    def rows(self, place: Place) -> list[dict[str, Any]]:
        """Images are compared first; what disagrees is not timed."""
        leaves = Leaves(*posed(place.scene, place.plan.size, MIDDLE))
        renderers = {"scgs_warp": rasterize.rasterization, "gsplat": self.rasterization}
        with torch.no_grad():
            agree(leaves.rasterize(rasterize.rasterization), leaves.rasterize(self.rasterization))
        rows = []
        for renderer, function in renderers.items():

            def forward(index: int, function: Callable[..., Any] = function) -> None:
                with torch.no_grad():
                    leaves.rasterize(function)

            def both(index: int, function: Callable[..., Any] = function) -> None:
                torch.autograd.grad(leaves.rasterize(function), (*leaves.geometry, leaves.harmonics), leaves.v_image)

            rows += place.rows("raster/forward", forward, {}, renderer)
            rows += place.rows("raster/both", both, {}, renderer)
        return rows


def agree(ours: Tensor, theirs: Tensor) -> None:
    """
    Args:
        ours, theirs: [C, H, W].

    Raises:
        UserError: by the rule of agreement they are not the same picture.
    """
    difference = (ours - theirs).abs().amax(0)
    within, largest = float((difference <= TOLERANCE).double().mean()), float(difference.max())
    if not (within >= AGREEING and largest <= LARGEST):  # NaN disagrees
        raise UserError(
            f"--against gsplat: the images differ ({100 * within:.3f} % of pixels within {TOLERANCE:g}, largest "
            f"difference {largest:.2g}), so times would compare nothing; try --gaussians instead of --run, or report it"
        )


PAPER_FPS = {"control-points": 295.4, "static": 298.5, "hexplane": 145.8, "per-gaussian": 113.3}
"""Frames a second in the seed's Table S2: 800 x 800, 48,980 Gaussians on average, RTX 3090 (SC-GS, 3D-GS, 4D-GS, and
the baseline that asks the network for every Gaussian)."""


def check_motions(text: str) -> tuple[str, ...]:
    """Names of motion models from a list with commas.

    Raises:
        UserError: one of them is none.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names or ("",):
        if name not in MOTIONS:
            raise UserError(f"--motion {text}: {name!r} is no motion model; choose from {','.join(MOTIONS)}")
    return names


def write(report: dict[str, Any], path: Path) -> None:
    """
    Raises:
        UserError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(f"--json {path}: cannot be written ({error.strerror}); name another file") from error
