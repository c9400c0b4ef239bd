"""One training step: render and compare each view, then update the parameters."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..config.presets import TrainConfig
from ..ops.adam import first_not_finite
from ..ops.pooled import pooled_residual
from ..ops.ssim import photometric_loss
from ..optim import log_linear
from ..rendering.render import draw
from ..seeding import generator
from ..types import Stats
from .camera_refinement import camera_rate
from .frames import Frames, view_number
from .multi_view import all_views
from .silhouettes import silhouette_term
from .state import StepResult, TrainState

SETTLED = 0.05
"""Factor on the constant learning rates at the last step."""
ALMOST = 0.9
"""Least opacity of spheres that must not fade, as a share of ``solid_opacity``: a sample still prefers others."""


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
        keep_solid(state)
        if state.motion_optimizer is not None and not motion_frozen(state):
            state.motion_optimizer.step()
        if state.refines_cameras:
            state.camera_optimizer.step()
            state.cameras.centre()
    for optimizer in state.optimizers():
        optimizer.zero_grad()
    return result._replace(failed=failed)


def one_view(state: TrainState, frames: Frames, view: int, stats: Stats) -> StepResult:
    """Pose, render and compare one frame, and backpropagate the loss.

    Adds to the parameters' gradients and to ``stats``. If the loss is non-finite, no gradients are added.

    Args:
        view: index of the view in the step's batch.
    """
    config, step = state.config, state.stage_step
    pretraining = state.stage == "pretrain"

    # 1. View: frame, camera and background. The frame after this process's next view is read in the background.
    progressive = config.pretrain.progressive and pretraining
    index = frames.index_at(step, progressive, view)
    random_background = pretraining and config.pretrain.random_background
    frame, camera, truth, background, mask = frames.view(index, state.step, random_background, view)
    later, next_view = divmod(view + (1 if state.group is None else state.group.size), config.batch)
    frames.expect(step + later, progressive, next_view)
    if state.refines_cameras:
        camera = state.cameras.apply(camera, index)

    # 2. Pose: the Gaussians at the frame's time, and the regulariser of the motion.
    time = noisy_time(frame.time, state, len(frames), view)
    posed, regulariser = state.motion.train_at(state.gaussians, time, step, config, config.seed, view)
    silhouette = frames.silhouettes.of(frame, index) if seeks_silhouettes(state) else None
    if silhouette is not None:
        random = generator(config.seed, 45, view_number(state.step, config, view))
        sought = config.pretrain.silhouette * silhouette_term(posed.means, camera, silhouette, random)
        regulariser = sought if regulariser is None else regulariser + sought

    # 3. Render. Statistics for densification are collected until it ends.
    collecting = pretraining or step < config.densify.until
    picture, _ = draw(
        posed,
        camera,
        background,
        sh_degree=sh_degree(state, step),
        stats=stats if collecting else None,
        antialiased=config.antialiased,
    )

    # 4. Compare.
    loss, l1, ssim = photometric_loss(picture, truth, mask, config.loss.ssim, log_weight(state))
    pooled = config.pretrain.pooled if pretraining else config.loss.pooled == "always"
    if pooled:
        loss = loss + pooled_residual(picture, truth, mask)
    total = loss if regulariser is None else loss + regulariser

    # 5. Backpropagate, unless the loss is non-finite.
    failed = _non_finite_term(loss, regulariser)
    if failed is None:
        total.backward()
    weighted = 0.0 if regulariser is None else float(regulariser.detach())
    losses, size = (loss.detach(), l1.detach(), ssim.detach(), weighted), (truth.shape[2], truth.shape[1])
    return StepResult(*losses, picture.detach(), truth, mask, failed, size)


def seeks_silhouettes(state: TrainState) -> bool:
    """Return True during the steps of stage 1 in which silhouettes draw the spheres: once the spheres move."""
    pretrain = state.config.pretrain
    return state.stage == "pretrain" and state.stage_step >= pretrain.warm_up and pretrain.silhouette > 0


def keep_solid(state: TrainState) -> None:
    """Raise the opacities of faded spheres to just below ``pretrain.solid_opacity``, unless they may fade."""
    pretrain = state.config.pretrain
    least = ALMOST * pretrain.solid_opacity
    if state.stage == "pretrain" and pretrain.fade == "never" and least > 0:
        state.gaussians.opacity_logits.data.clamp_(min=math.log(least / (1.0 - least)))


def sh_degree(state: TrainState, step: int) -> int:
    """Return the degree of spherical harmonics at this step of the stage; it grows by one every ``densify.sh_every``
    steps."""
    return min(state.gaussians.sh_degree, step // state.config.densify.sh_every)


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


def log_weight(state: TrainState) -> float:
    """Return the weight of the logarithm of the squared error: 0 until ``loss.log_error_from`` of the main stage."""
    config = state.config
    begins = round(config.loss.log_error_from * config.main_steps)
    return config.loss.log_error if state.stage == "main" and state.stage_step >= begins else 0.0


def settling(step: int, config: TrainConfig) -> float:
    """Return the factor on the constant rates: 1, then decaying log-linearly to ``SETTLED`` over the last share of the
    main stage. Without the decay, each colour would keep oscillating about its optimum."""
    length = round(config.optim.settle * config.main_steps)
    passed = step - (config.main_steps - length)
    return log_linear(1.0, SETTLED, passed, length) if length > 0 and passed > 0 else 1.0


def noisy_time(time: float, state: TrainState, frames: int, view: int = 0) -> float:
    """Add noise to a view's time, for data in which the cameras move between instants. The noise keeps the motion from
    jumping from frame to frame; it fades until ``optim.network_until``."""
    config = state.config
    fade = max(0.0, 1.0 - state.stage_step / config.optim.network_until)
    spread = config.motion.time_noise * fade / max(frames - 1, 1)
    if spread == 0.0:
        return time
    noise = torch.randn(1, generator=generator(config.seed, 43, view_number(state.step, config, view)))
    return min(max(time + spread * float(noise), 0.0), 1.0)


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
