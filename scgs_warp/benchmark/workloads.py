"""Workloads: a frame of the moving scene, a rasterisation, a training step."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ..errors import UserError
from ..motion import ControlPoints, HexPlane, PerGaussian, control_points
from ..motion.base import Motion
from ..ops.binning import bin_splats
from ..ops.compositing import composite
from ..ops.harmonics import spherical_harmonics
from ..ops.projection import project
from ..rendering import render
from ..scene.scene import Scene
from ..seeding import generator
from ..training import view as training_view
from ..training.frames import Frames
from ..training.state import StepResult, TrainState
from ..training.stepping import PlainSteps, steps_of
from ..types import Camera, Gaussians
from .plan import MIDDLE, BenchCase, posed
from .scenes import Size, scene_camera, training_data, training_state

RENDER_STAGES = {
    "project": ("project",),
    "harmonics": ("spherical_harmonics", "colors_and_depths"),
    "bin": ("bin_splats",),
    "composite": ("composite",),
}
"""Functions of each stage of rendering; the harmonics of a frame on a GPU are computed beside its depths."""


def motion_stages(motion: Motion, training: bool = False) -> dict[str, list[tuple[Any, str]]]:
    """Return the functions to time for each stage of a motion model.

    The stage ``network`` includes a hexplane model's planes and, in training, their smoothness term. Models with
    control points add ``skin``, which in training includes the search for neighbours, and in training ``arap``.
    """
    if isinstance(motion, ControlPoints):
        stages: dict[str, list[tuple[Any, str]]] = {"network": [(motion, "poses" if training else "pose_at")]}
        stages["skin"] = [(motion, "bind_and_pose"), (motion, "apply_pose")]
        if training:
            stages["arap"] = [(motion, "refresh_graph"), (control_points, "rigidity")]
        return stages
    if isinstance(motion, PerGaussian):
        return {"network": [(motion.network, "forward")]}
    if isinstance(motion, HexPlane):
        return {"network": [(motion, "train_at" if training else "gaussians_at")]}
    return {}


def draw_stages(module: Any) -> dict[str, list[tuple[Any, str]]]:
    return {
        stage: [(module, name) for name in names if hasattr(module, name)] for stage, names in RENDER_STAGES.items()
    }


def instant(index: int) -> float:
    """Return the time of frame ``index``, in [0.3, 0.7], different for each frame."""
    return 0.5 + 0.4 * ((0.37 * index) % 1.0 - 0.5)


def frames_of(scene: Scene, size: Size) -> Callable[[int], None]:
    """Return the function that draws frame ``index`` as a viewer would."""
    camera = scene_camera(scene, size)

    def draw(index: int) -> None:
        scene.render(camera, instant(index))

    return draw


def frame_rows(case: BenchCase) -> list[dict[str, Any]]:
    """Measure frames of the moving scene, each at another time, so that the network runs unless poses are kept;
    neighbours are cached.

    On CUDA the whole is a recorded graph, in which nothing can be timed, so its stages are those of a frame drawn step
    by step.
    """
    scene = case.scene
    camera = scene_camera(scene, case.plan.size)
    targets = {**motion_stages(scene.motion), **draw_stages(render)}

    @torch.no_grad()
    def steps(index: int) -> None:
        view = scene.normalisation.apply_camera(camera).to(scene.device)
        color = torch.tensor(scene.background_color, device=scene.device)
        posed = scene.motion.gaussians_at(scene.gaussians, instant(index))
        render.render(posed, view, color, antialiased=scene.config.antialiased)

    whole = frames_of(scene, case.plan.size)
    return case.rows("frame", whole, targets, staged=steps if case.plan.device == "cuda" else None)


class Leaves:
    """Gaussians as leaf tensors, of sharpness 0 as other programs draw them, and the gradient of an image."""

    def __init__(self, gaussians: Gaussians, camera: Camera) -> None:
        def leaf(value: Tensor) -> Tensor:
            return value.detach().clone().requires_grad_()

        self.camera = camera
        gaussians = gaussians.plain()
        self.gaussians = replace(gaussians, **{name: leaf(value) for name, value in gaussians.tensors().items()})
        self.harmonics = leaf(torch.cat([gaussians.sh_dc[:, None], gaussians.sh_rest], dim=1))
        self.degree = round(self.harmonics.shape[1] ** 0.5) - 1
        self.v_image = torch.rand(3, camera.height, camera.width, generator=generator(0, 4)).to(self.harmonics.device)

    @property
    def geometry(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        own = self.gaussians
        return own.means, own.quats, own.scales, own.opacities

    def draw(self) -> Tensor:
        """Draw [3, H, W] by the project's own stages."""
        own, camera = self.gaussians, self.camera
        splats = project(*self.geometry, camera.viewmat, camera.K, camera.width, camera.height)
        colors = spherical_harmonics(own.sh_dc, own.sh_rest, own.means, camera.position, self.degree)
        return composite(splats, colors, bin_splats(splats))[0]

    def rasterize(self, rasterization: Callable[..., Any]) -> Tensor:
        """Draw [3, H, W] through the entry point that gsplat and this project share."""
        camera = self.camera
        views = camera.viewmat[None], camera.K[None], camera.width, camera.height
        image = rasterization(*self.geometry, self.harmonics, *views, sh_degree=self.degree, packed=False)[0]
        return image[0].permute(2, 0, 1)


def raster_rows(case: BenchCase, forward: bool = True) -> list[dict[str, Any]]:
    """Measure projection, harmonics, binning and compositing of three channels: forward alone (unless ``forward`` is
    False), and forward with all gradients."""
    leaves = Leaves(*posed(case.scene, case.plan.size, MIDDLE))
    module = _this_module()

    def draw(index: int) -> None:
        with torch.no_grad():
            leaves.draw()

    def both(index: int) -> None:
        torch.autograd.grad(leaves.draw(), tuple(leaves.gaussians.tensors().values()), leaves.v_image)

    backward = {"backward": [(torch.autograd, "grad")]}
    rows = case.rows("raster/forward", draw, draw_stages(module)) if forward else []
    return rows + case.rows("raster/both", both, {**draw_stages(module), **backward})


def _this_module() -> Any:
    return sys.modules[__name__]


def step_rows(case: BenchCase) -> list[dict[str, Any]]:
    """Measure training steps of the main stage on images of the scene, without and (if any) with the ARAP term.

    On CUDA the whole is a recorded graph, so its stages are those of a step taken operation by operation.
    """
    scene = case.scene
    data = training_data(scene, case.plan.size)
    rows = []
    for name, arap in (("step", False), ("step/arap", True)):
        if arap and not isinstance(scene.motion, ControlPoints):
            continue
        scene.motion.cache_binding(None)
        state = training_state(scene, arap)
        frames = Frames(data, scene.normalisation, state.config, case.plan.device)
        targets = {
            **motion_stages(scene.motion, training=True),
            **draw_stages(render),
            "loss": [(training_view, "photometric_loss")],
            "backward": [(torch.Tensor, "backward")],
            "adam": [(one, "step") for one in (state.gaussian_optimizer, state.motion_optimizer) if one is not None],
        }

        taken = steps_of(state, frames)

        def step(index: int, state: TrainState = state, take: Callable[[], list[StepResult]] = taken.take) -> None:
            if any(result.failed is not None for result in take()):
                raise UserError(
                    f"step: the loss of {scene.motion_name} is not finite; measure another scene with --run"
                )
            state.step += 1

        plain = partial(step, take=PlainSteps(state, frames).take) if case.plan.device == "cuda" else None
        rows += case.rows(name, step, targets, staged=plain)
    scene.motion.eval()
    scene.freeze_binding()
    return rows
