"""One training step: render and compare each view, then update the parameters."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..config.presets import TrainConfig
from ..ops.adam import first_not_finite
from ..optim import log_linear
from ..runtime.device_copies import sent
from ..types import Camera, Stats
from .camera_refinement import camera_rate
from .depth import SeenDepth
from .flow import FlowNumbers, flow_weight
from .frames import Frames
from .multi_view import all_views
from .recall import shows_too_little
from .state import StepResult, TrainState
from .view import Numbers, View, compare, prepare

SETTLED = 0.05
"""Factor on the constant learning rates at the last step."""
ALMOST = 0.9
"""Least opacity of spheres that must not fade, as a share of ``solid_opacity``. It is below 1, so that a sample of the
solid spheres still leaves them out."""


def training_step(state: TrainState, frames: Frames) -> StepResult:
    """Render and compare each view of the batch, then update the parameters.

    Changes ``state``, except its ``step``. If a loss or gradient is non-finite, all parameters stay unchanged.
    """
    # 1. Learning rates, and the gradients of all views.
    set_rates(state)
    if state.config.batch == 1:
        result = one_view(state, frames, 0, state.stats)
    else:
        result = all_views(state, frames, one_view)

    # 2. Update.
    failed = result.failed or _non_finite_gradient(state)
    if failed is None:
        state.gaussian_optimizer.step()
        least = least_logit(state)
        if least is not None:
            state.gaussians.opacity_logits.data.clamp_(min=least)
        if state.motion_optimizer is not None and not motion_frozen(state):
            state.motion_optimizer.step()
        if state.refines_cameras:
            state.camera_optimizer.step()
            state.cameras.centre()
        if state.exposure_optimizer is not None:
            state.exposure_optimizer.step()
            state.exposure.centre()
    for optimizer in state.optimizers():
        optimizer.zero_grad()
    return result._replace(failed=failed)


def one_view(state: TrainState, frames: Frames, view: int, stats: Stats) -> StepResult:
    """Pose, render and compare one frame, and backpropagate the loss.

    Adds to the parameters' gradients and to ``stats``. If the loss is non-finite, no gradients are added.

    Args:
        view: index of the view in the step's batch.
    """
    # 1. Prepare the view, pose, render, compare.
    prepared = prepare(state, frames, view)
    plan, given, device = prepared.plan, prepared.camera, state.device
    camera = Camera(sent(given.viewmat, device), sent(given.K, device), given.width, given.height)
    if state.refines_cameras:
        camera = state.cameras.apply(camera, prepared.index)
    times = sent(torch.tensor(plan.times), device)
    color = state.exposure.color(prepared.index) if len(state.exposure) else None
    flow, depth = _flow(state, prepared), _depth(state, prepared)
    background = sent(prepared.background, device)
    numbers = Numbers(camera, background, times, plan.weight, color, flow, depth, prepared.depth_weight)
    compared = compare(state, prepared, numbers, stats)
    if color is not None:
        compared = compared.with_penalty(state.exposure.penalty(prepared.index, state.config.loss))

    # 2. Backpropagate, unless the loss is non-finite.
    failed = _non_finite_term(compared.loss, compared.regulariser)
    if failed is None:
        compared.total.backward()
    if state.config.batch == 1 and shows_too_little(float(compared.shown), float(compared.l1.detach())):
        state.recalls = state.recalls.after_nothing_shown(state.step)
    weighted = 0.0 if compared.regulariser is None else float(compared.regulariser.detach())
    losses = (compared.loss.detach(), compared.l1.detach(), compared.ssim.detach(), weighted)
    size = given.width, given.height
    images = compared.picture.detach(), prepared.truth, prepared.mask
    return StepResult(state.step, *losses, *images, failed, size)


def _flow(state: TrainState, prepared: View) -> FlowNumbers | None:
    """Send the flow that the step compares to the device, with the refined cameras if cameras are refined."""
    flow, device = prepared.flow, state.device
    if flow is None:
        return None
    camera, other = flow.camera.to(device), flow.other_camera.to(device)
    if state.refines_cameras:
        with torch.no_grad():
            camera = state.cameras.apply(camera, prepared.index)
            other = state.cameras.apply(other, flow.other)
    weight = flow_weight(state.stage_step, state.config)
    return FlowNumbers(camera, other, sent(flow.vectors, device), sent(flow.certain, device), weight)


def _depth(state: TrainState, prepared: View) -> SeenDepth | None:
    """Send the depth that the step compares to the device, with the refined camera if cameras are refined."""
    seen, device = prepared.depth, state.device
    if seen is None:
        return None
    camera = seen.camera.to(device)
    if state.refines_cameras:
        camera = state.cameras.apply(camera, prepared.index)
    return SeenDepth(camera, sent(seen.inverse, device))


def least_logit(state: TrainState) -> float | None:
    """Return the least logit of the spheres' opacities, just below ``pretrain.solid_opacity``; None if they may
    fade."""
    pretrain = state.config.pretrain
    least = ALMOST * pretrain.solid_opacity
    solid = state.stage == "pretrain" and pretrain.fade == "never" and least > 0
    return math.log(least / (1.0 - least)) if solid else None


def motion_frozen(state: TrainState) -> bool:
    """Return True during the main steps at the beginning in which only the Gaussians learn."""
    return state.stage == "main" and state.stage_step < state.config.rest_steps


def set_rates(state: TrainState) -> None:
    """Set every learning rate for this step."""
    config, step = state.config, state.stage_step
    means = log_linear(config.optim.means, config.optim.means_end, step, config.optim.means_until)
    settled = settling(step, config)
    base = state.gaussian_rates()
    for name, group in state.gaussian_optimizer.groups.items():
        group.rate = means if name == "means" else base[name] * (settled if state.stage == "main" else 1.0)
    if state.motion_optimizer is not None:
        rates = state.motion.rates(step, config)
        for name, group in state.motion_optimizer.groups.items():
            group.rate = rates[name]
    state.camera_optimizer.groups["twists"].rate = camera_rate(step, config.optim, config.rest_steps)
    if state.exposure_optimizer is not None:
        settled_colors = settled if state.stage == "main" else 1.0
        state.exposure_optimizer.groups["offsets"].rate = config.optim.frame_colors * settled_colors


def settling(step: int, config: TrainConfig) -> float:
    """Return the factor on the constant rates: 1, then decaying log-linearly to ``SETTLED`` over the last share of the
    main stage. Without the decay, each colour would keep oscillating about its optimum."""
    length = round(config.optim.settle * config.main_steps)
    passed = step - (config.main_steps - length)
    return log_linear(1.0, SETTLED, passed, length) if length > 0 and passed > 0 else 1.0


def _non_finite_term(loss: Tensor, regulariser: Tensor | None) -> str | None:
    if not math.isfinite(float(loss.detach())):
        return "image loss"
    if regulariser is not None and not math.isfinite(float(regulariser.detach())):
        return "regulariser"
    return None


def _non_finite_gradient(state: TrainState) -> str | None:
    named = [pair for optimizer in state.optimizers() for pair in optimizer.gradients()]
    bad = first_not_finite([gradient for _, gradient in named])
    return None if bad is None else f"gradient of {named[bad][0]}"
