"""Training: ``fit`` is the loop, ``training_step`` one step of it, in the order things happen."""

from __future__ import annotations

import math
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from . import checkpoint, environment
from .adapt import adapt
from .batch import all_views, check_replicas, check_share
from .camera_refinement import camera_rate
from .config import TrainConfig
from .contribution import seen
from .data.dataset import Dataset
from .errors import FrameError, UserError
from .frames import Frames, view_number
from .limits import check
from .memory import NotEnoughMemory
from .ops.adam import first_not_finite
from .ops.ssim import photometric_loss
from .optim import generator, log_linear
from .parallel import Lost, Team
from .progress import Progress, progress
from .render import draw
from .run_folder import Onlooker, RunFolder
from .scene import Scene
from .stopping import stop_signals
from .train_state import TrainState
from .types import Stats

SETTLED = 0.05
"""What remains of the constant rates at the last step."""
MOST_FAILURES = 20
"""Non-finite steps in a row after which training stops at the last good state."""
COMPARE_EVERY = 500
"""Steps after which processes that train together make sure that they hold the same scene."""


class StepResult(NamedTuple):
    """What a step reports: detached scalars, the mean over its views, and a picture for previews."""

    loss: Tensor
    l1: Tensor
    ssim: Tensor
    regulariser: float
    render: Tensor
    truth: Tensor
    mask: Tensor | None
    """[H, W] bool, the pixels that count; None: all."""
    failed: str | None
    """The name of the term that was not finite, if any; the step was dropped."""
    size: tuple[int, int]
    """Width and height of the step's first view, in pixels."""


def training_step(state: TrainState, frames: Frames) -> StepResult:
    """One step: look at each view of the batch, then change the parameters. Changes ``state``, except its ``step``."""
    set_rates(state)
    if state.config.batch == 1:
        result = one_view(state, frames, 0, state.stats)
    else:
        result = all_views(state, frames, one_view)
    failed = result.failed or _bad_gradient(state)
    if failed is None:
        state.gaussian_optimizer.step()
        if state.motion_optimizer is not None and not frozen(state):
            state.motion_optimizer.step()
        if state.refines_cameras:
            state.camera_optimizer.step()
            state.cameras.centre()
    for optimizer in state.optimizers():
        optimizer.zero_grad()
    return result._replace(failed=failed)


def one_view(state: TrainState, frames: Frames, view: int, stats: Stats) -> StepResult:
    """One frame: pose, render, compare, go back. Adds to the parameters' gradients and to ``stats``; a loss that is not
    finite adds nothing.

    Args:
        view: which one of the step's batch.
    """
    config, step = state.config, state.stage_step
    pretraining = state.stage == "pretrain"
    progressive = config.pretrain.progressive and pretraining
    index = frames.index_at(step, progressive, view)
    random_background = pretraining and config.pretrain.random_background
    frame, camera, truth, background, mask = frames.view(index, state.step, random_background, view)
    later, next_view = divmod(view + (1 if state.team is None else state.team.size), config.batch)
    frames.expect(step + later, progressive, next_view)
    if state.refines_cameras:
        camera = state.cameras.apply(camera, index)

    time = noisy_time(frame.time, state, len(frames), view)
    posed, regulariser = state.motion.train_at(state.gaussians, time, step, config, config.seed, view)
    collecting = pretraining or step < config.densify.until
    picture, _ = draw(
        posed,
        camera,
        background,
        sh_degree=min(state.gaussians.sh_degree, step // config.densify.sh_every),
        stats=stats if collecting else None,
        antialiased=config.antialiased,
    )
    loss, l1, ssim = photometric_loss(picture, truth, mask, config.loss.ssim)
    total = loss if regulariser is None else loss + regulariser

    failed = _not_finite(loss, regulariser)
    if failed is None:
        total.backward()
    weighted = 0.0 if regulariser is None else float(regulariser.detach())
    losses, size = (loss.detach(), l1.detach(), ssim.detach(), weighted), (truth.shape[2], truth.shape[1])
    return StepResult(*losses, picture.detach(), truth, mask, failed, size)


def frozen(state: TrainState) -> bool:
    """Main steps in which only the Gaussians learn (seed S4)."""
    return state.stage == "main" and state.stage_step < state.config.rest_steps


def set_rates(state: TrainState) -> None:
    """Every learning rate is a function of the step."""
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


def settling(step: int, config: TrainConfig) -> float:
    """Factor of the constant rates: 1, then log-linearly to ``SETTLED`` over the last share of the main stage. Steps
    that stay large shake every colour about its best value."""
    length = round(config.optim.settle * config.main_steps)
    passed = step - (config.main_steps - length)
    return log_linear(1.0, SETTLED, passed, length) if length > 0 and passed > 0 else 1.0


def noisy_time(time: float, state: TrainState, frames: int, view: int = 0) -> float:
    """The view's time with noise, for data whose cameras stand elsewhere at every time: it keeps the motion from
    jumping from frame to frame."""
    config = state.config
    fade = max(0.0, 1.0 - state.stage_step / config.optim.network_until)
    spread = config.motion.time_noise * fade / max(frames - 1, 1)
    if spread == 0.0:
        return time
    noise = torch.randn(1, generator=generator(config.seed, 43, view_number(state.step, config, view)))
    return min(max(time + spread * float(noise), 0.0), 1.0)


def _not_finite(loss: Tensor, regulariser: Tensor | None) -> str | None:
    if not math.isfinite(float(loss.detach())):
        return "image loss"
    if regulariser is not None and not math.isfinite(float(regulariser.detach())):
        return "regulariser"
    return None


def _bad_gradient(state: TrainState) -> str | None:
    named = [pair for optimizer in state.optimizers() for pair in optimizer.gradients()]
    bad = first_not_finite([gradient for _, gradient in named])
    return None if bad is None else f"gradient of {named[bad][0]}"


def fit(
    config: TrainConfig,
    data: Dataset,
    *,
    output: str | Path,
    device: str = "cpu",
    test: Dataset | None = None,
    resume: bool = False,
    settings: dict[str, Any] | None = None,
    tensorboard: bool = False,
    team: Team | None = None,
) -> Scene:
    """Train a scene; the run directory holds a resumable checkpoint at any time.

    Args:
        config: the complete configuration: a ``config.preset``, and what ``config.with_steps`` and ``from_dict`` make
            of it.
        data: training frames, world units (``data.load``).
        output: run directory; made if needed.
        device: where everything is computed, ``cpu`` or ``cuda``.
        test: held-out frames, looked at for the curve and the previews alone; nothing is selected by them.
        resume: continue from the checkpoint in ``output``, to the same bits as an uninterrupted run; from the one
            before it where that is damaged, from the beginning where the run was killed before there was any.
        settings: what to write to ``config.json``; default: the configuration.
        tensorboard: also write event files for TensorBoard to ``output``; changes no bit of the scene.
        team: the processes that share each step's views (``parallel.team_of``); ``config.batch`` must be a multiple of
            their number. The first of them writes, ``output`` is read by all.

    Returns:
        the scene after the last step, in every process.

    Raises:
        UserError: a bad configuration, a checkpoint that does not fit or cannot be written, an image that is gone,
            repeated non-finite losses, no TensorBoard, a process of the team was lost. What was saved last is intact.
        NotEnoughMemory: one tile of an image takes more than there is; the checkpoint is saved.
        KeyboardInterrupt: after Ctrl-C, SIGTERM or the end of the terminal, the checkpoint being saved.
    """
    check(config)
    check_share(config, team)
    environment.ensure_configured()
    if data.background != config.data.background:
        raise UserError(f"{data.folder}: loaded on {data.background}, but data.background is {config.data.background}")
    if len(data) == 0:
        raise UserError(f"{data.folder}: the {data.split} split has no frames; nothing to train on")
    folder_type = RunFolder if team is None or team.first else Onlooker
    with folder_type(output, config, settings, resume=resume, tensorboard=tensorboard) as folder:
        begin = partial(_state, folder, config, data, device)
        # The first of several processes may have to put a checkpoint in its place before the others read it.
        state = team.in_turn(begin) if team is not None and resume else begin()
        state.team = team
        frames = Frames(data, state.normalisation, config, device)
        folder.begin(state.step)
        with progress(config.steps, "training", start=state.step) as bar, stop_signals() as stop:
            folder.tell = bar.print
            try:
                check_replicas(state)
                _loop(state, frames, folder, test, bar, stop)
            except Lost as lost:
                raise _without_others(state, folder, lost) from lost
        state.motion.eval()
        return state.scene()


def _state(folder: RunFolder, config: TrainConfig, data: Dataset, device: str) -> TrainState:
    """Where the run begins, or goes on."""
    if folder.resume and folder.has_begun:
        folder.tell(f"{folder.path}: there is no checkpoint yet; training begins again from step 0")
    elif folder.resume:
        try:
            return TrainState.resume(folder.path, config, data, device)
        except checkpoint.DamagedCheckpoint as error:
            if isinstance(folder, Onlooker):
                raise UserError(f"{error}; the first process could read it") from error
            folder.tell(f"warning: {checkpoint.fall_back(folder.path, error)}")
        return TrainState.resume(folder.path, config, data, device)
    return TrainState.begin(config, data, device)


def _loop(
    state: TrainState, frames: Frames, folder: RunFolder, test: Dataset | None, bar: Progress, stop: threading.Event
) -> None:
    config, noted = state.config, False
    saved_at = time.monotonic()
    while state.step < config.steps:
        if state.stage == "pretrain" and state.step >= config.pretrain_steps:
            state.begin_main()
        try:
            kept = seen(state, frames)
            result = training_step(state, frames)
        except NotEnoughMemory:  # before anything was changed: the run goes on where there is more
            state.save(folder.path)
            raise
        except FrameError as error:
            state.save(folder.path)
            saved = f"step {state.step} is saved: " if state.team is None or state.team.first else ""
            raise UserError(f"{error}; {saved}continue with --resume") from error
        if result.failed is None:
            state.failures = 0
        else:
            _count_failure(state, result.failed, folder, bar)
        done = state.step + 1
        if test is not None and (done % config.evaluate_every == 0 or done == config.steps):
            folder.look_at_test(state.scene(), test, done)  # not after an opacity reset: the curve would show its dips
        state.whole = False
        note = adapt(state, result.size, kept)
        if note is not None and not noted:
            noted = True
            bar.print(f"step {state.step}: {note}")
            folder.log({"step": state.step, "stage": state.stage, "note": note})
        state.step += 1
        state.whole = True
        last = state.step == config.steps
        stopping = stop.is_set() if state.team is None else state.team.any(stop.is_set())
        if last or stopping or state.step % COMPARE_EVERY == 0:
            check_replicas(state)
        folder.record(state, result, bar)
        now = time.monotonic()
        if now - saved_at >= config.checkpoint_seconds or last or stopping:
            state.save(folder.path)
            saved_at = time.monotonic()
        if stopping:
            if state.team is not None:
                state.team.meet()  # torchrun ends all processes when one has ended: the first must have saved
            bar.print(f"stopped at step {state.step}; the checkpoint is saved, continue with --resume")
            raise KeyboardInterrupt


def _without_others(state: TrainState, folder: RunFolder, lost: Lost) -> UserError:
    """What is left to do when another process is gone: no step can be finished, but mostly none has been begun either,
    for parameters change when all views are there."""
    assert state.team is not None
    if state.step == 0:
        return UserError(f"{folder.path}: {lost}; no step was done yet")
    if state.whole:
        state.save(folder.path)
    where = f"step {state.step} is saved" if state.team.first and state.whole else f"reached step {state.step}"
    return UserError(
        f"{folder.path}: {lost}; {where}, continue from the checkpoint with --resume, on one process or any number "
        f"that divides batch {state.config.batch}"
    )


def _count_failure(state: TrainState, term: str, folder: RunFolder, bar: Progress) -> None:
    state.failures += 1
    bar.print(f"step {state.step}: {term} is not finite; the step was dropped")
    folder.log({"step": state.step, "stage": state.stage, "dropped": term})
    if state.failures >= MOST_FAILURES:
        state.save(folder.path)  # no dropped step has touched the parameters
        raise UserError(
            f"{folder.path}: {term} was not finite {MOST_FAILURES} times in a row, up to step {state.step}; the "
            "checkpoint holds the last good state; lower the learning rates or check the data, then --resume"
        )
