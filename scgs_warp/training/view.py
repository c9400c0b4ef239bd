"""One training view: prepared on the host, then posed, rendered and compared on the device.

:func:`prepare` draws all random numbers and reads the images; :func:`compare` neither waits for the device nor copies
from the host, so that a step can be recorded (``recorded_step``), unless it may draw back Gaussians (``recall``).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import NamedTuple

import torch
from torch import Tensor

from ..motion.base import MotionStep
from ..ops.pooled import pooled_residual
from ..ops.ssim import photometric_loss
from ..rendering.render import draw
from ..seeding import Purpose, generator
from ..types import Camera, Splats, Stats, Tiles
from .depth import SeenDepth, depth_term, depth_weight
from .exposure import exposed
from .flow import Flow, FlowNumbers, flow_term, flow_weight
from .frames import Frames, view_number
from .recall import recall, shows_too_little
from .silhouettes import SilhouetteSample, silhouette_term
from .state import TrainState


class View(NamedTuple):
    """What a step needs of one view. ``choices`` and the shapes decide which operations the step consists of."""

    index: int
    """Index of the frame."""
    camera: Camera
    """Normalised, on the host."""
    background: Tensor
    """[3] on the host."""
    plan: MotionStep
    choices: Choices
    truth: Tensor
    """[3, H, W] on the device, on the background."""
    mask: Tensor | None
    """[H, W] bool on the device, True where the pixel is valid."""
    sample: SilhouetteSample | None
    """Part of the image's silhouette, on the device."""
    flow: Flow | None = None
    """Optical flow to another frame, in steps that compare it."""
    depth: SeenDepth | None = None
    """Depth map of the frame, on the host, in steps that compare it."""
    depth_weight: float = 0.0


class Choices(NamedTuple):
    """What chooses the operations of a view's step. It changes a few times in a run."""

    sh_degree: int
    collects: bool
    """True while statistics for densification are collected."""
    log_weight: float
    pooled: bool


class Numbers(NamedTuple):
    """Numbers of a view that change from step to step, on the device."""

    camera: Camera
    background: Tensor
    """[3]"""
    times: Tensor
    """[T] those of the plan."""
    weight: float | Tensor
    """Weight of the motion's regulariser."""
    color: Tensor | None = None
    """[3, 4] affine colour of the frame; None: frames have none."""
    flow: FlowNumbers | None = None
    """None: the step compares no flow."""
    depth: SeenDepth | None = None
    """None: the step compares no depth."""
    depth_weight: float | Tensor = 0.0


class Compared(NamedTuple):
    """Loss of one view and its parts, scalars, and the picture [3, H, W]."""

    total: Tensor
    """What is minimised: the loss, and the regulariser if there is one."""
    loss: Tensor
    l1: Tensor
    ssim: Tensor
    regulariser: Tensor | None
    """Weighted; None in steps without the term."""
    picture: Tensor
    shown: Tensor
    """Largest alpha of the picture."""

    def with_penalty(self, penalty: Tensor) -> Compared:
        """Add a penalty to the regulariser."""
        return self._replace(total=self.total + penalty, regulariser=_plus(self.regulariser, penalty))


def _plus(regulariser: Tensor | None, term: Tensor) -> Tensor:
    return term if regulariser is None else regulariser + term


def prepare(state: TrainState, frames: Frames, view: int = 0) -> View:
    """Choose and load the frame of this step's ``view``, and draw the step's random numbers.

    The frame after this process's next view is read in the background.

    Raises:
        FrameError: the frame's file is no longer readable.
    """
    config, step = state.config, state.stage_step
    pretraining = state.stage == "pretrain"
    progressive = config.pretrain.progressive and pretraining
    index = frames.index_at(step, progressive, view)
    random_background = varies_background(state)
    loaded = frames.load(index, state.step, random_background, seeks_silhouettes(state), view)
    later, next_view = divmod(view + (1 if state.group is None else state.group.size), config.batch)
    frames.expect(step + later, progressive, next_view)
    time = noisy_time(frames.data.entries[index].time, state, len(frames), view)
    plan = state.motion.plan(state.gaussians, time, step, config, view)
    number = view_number(state.step, config, view)
    random = generator(config.seed, Purpose.SILHOUETTE_PIXELS, number)
    sample = None if loaded.silhouette is None else loaded.silhouette.sample(random)
    pooled = config.pretrain.pooled if pretraining else config.loss.pooled == "always"
    collects = pretraining or step < config.densify.until
    choices = Choices(sh_degree(state, step), collects, log_weight(state), pooled)
    flow = None
    if state.stage == "main" and flow_weight(step, config) > 0.0:
        flow = frames.flows.between(index, generator(config.seed, Purpose.FLOW_FRAME, number))
    weight = depth_weight(step, config) if state.stage == "main" else 0.0
    depth = frames.depths.of(index) if weight > 0.0 else None
    images = loaded.truth, loaded.mask, sample, flow, depth
    return View(index, loaded.camera, loaded.background, plan, choices, *images, depth_weight=weight)


def compare(
    state: TrainState,
    view: View,
    numbers: Numbers,
    stats: Stats,
    binned: Callable[[Splats], Tiles] | None = None,
) -> Compared:
    """Pose and render the Gaussians as the view sees them, and compare the picture with the truth.

    Args:
        stats: what the backward pass adds to, if the step collects statistics.
        binned: as in ``render.draw``.
    """
    config, camera, choices = state.config, numbers.camera, view.choices
    # 1. Pose: the Gaussians at the frame's time, and the regulariser of the motion.
    posed, regulariser = state.motion.train_at(state.gaussians, view.plan, numbers.times, numbers.weight, config)
    if view.sample is not None:
        sought = config.pretrain.silhouette * silhouette_term(posed.means, camera, view.sample)
        regulariser = _plus(regulariser, sought)

    # 2. Render.
    picture, alpha = draw(
        posed,
        camera,
        numbers.background,
        sh_degree=choices.sh_degree,
        stats=stats if choices.collects else None,
        antialiased=config.antialiased,
        binned=binned,
    )

    if numbers.color is not None:
        picture = exposed(picture, alpha, numbers.background, numbers.color)

    # 3. Compare.
    if numbers.flow is not None and view.flow is not None:
        there = state.motion.means_at(state.gaussians, view.flow.time)
        regulariser = _plus(regulariser, numbers.flow.weight * flow_term(posed, there, numbers.flow))
    if numbers.depth is not None:
        regulariser = _plus(regulariser, numbers.depth_weight * depth_term(posed, numbers.depth, binned))
    loss, l1, ssim = photometric_loss(picture, view.truth, view.mask, config.loss.ssim, choices.log_weight)
    if choices.pooled:
        loss = loss + pooled_residual(picture, view.truth, view.mask)
    shown = alpha.detach().amax()
    if may_recall(state) and shows_too_little(float(shown), float(l1.detach())):
        regulariser = _plus(regulariser, recall(posed.means))
    total = loss if regulariser is None else loss + regulariser
    return Compared(total, loss, l1, ssim, regulariser, picture, shown)


def may_recall(state: TrainState) -> bool:
    """Return whether the step may draw back Gaussians; the host waits for such a step. With several views it always
    may."""
    return state.config.batch > 1 or state.recalls.holds(state.step)


def operations_key(view: View, *others: Hashable) -> Hashable:
    """Return a key that is equal for views whose steps consist of the same operations on tensors of the same shapes."""
    distances = None if view.sample is None else view.sample.distances.shape
    depth = None if view.depth is None else view.depth.inverse.shape
    plan = view.plan.phase, len(view.plan.times), view.plan.weight != 0.0
    return view.choices, plan, view.truth.shape, view.mask is None, distances, depth, *others


def seeks_silhouettes(state: TrainState) -> bool:
    """Return True during the steps of stage 1 in which silhouettes draw the spheres: once the spheres move."""
    pretrain = state.config.pretrain
    return state.stage == "pretrain" and state.stage_step >= pretrain.warm_up and pretrain.silhouette > 0


def varies_background(state: TrainState) -> bool:
    """Return True in steps whose background is random: those of stage 1, and an even share of the main stage's."""
    if state.stage == "pretrain":
        return state.config.pretrain.random_background
    step, share = state.stage_step, state.config.loss.random_background
    return int((step + 1) * share) > int(step * share)


def sh_degree(state: TrainState, step: int) -> int:
    """Return the degree of spherical harmonics at this step of the stage; it grows by one every ``densify.sh_every``
    steps."""
    return min(state.gaussians.sh_degree, step // state.config.densify.sh_every)


def log_weight(state: TrainState) -> float:
    """Return the weight of the logarithm of the squared error: 0 until ``loss.log_error_from`` of the main stage."""
    config = state.config
    begins = round(config.loss.log_error_from * config.main_steps)
    return config.loss.log_error if state.stage == "main" and state.stage_step >= begins else 0.0


def noisy_time(time: float, state: TrainState, frame_count: int, view: int = 0) -> float:
    """Add noise to a view's time, for data in which the cameras move between instants. The noise keeps the motion from
    jumping from frame to frame; it fades until ``optim.network_until``."""
    config = state.config
    fade = max(0.0, 1.0 - state.stage_step / config.optim.network_until)
    spread = config.motion.time_noise * fade / max(frame_count - 1, 1)
    if spread == 0.0:
        return time
    noise = torch.randn(1, generator=generator(config.seed, Purpose.TIME_NOISE, view_number(state.step, config, view)))
    return min(max(time + spread * float(noise), 0.0), 1.0)
