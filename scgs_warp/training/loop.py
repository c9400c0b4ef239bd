"""Training: ``fit`` is the loop, ``training_step`` one step of it, in the order things happen."""

from __future__ import annotations

import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

from ..config.presets import TrainConfig
from ..config.validation import check
from ..data.dataset import Dataset
from ..errors import FrameError, UserError
from ..runtime import environment
from ..runtime.memory import NotEnoughMemory
from ..runtime.progress import Progress, progress
from ..runtime.stop_signals import stop_signals
from ..scene.scene import Scene
from ..storage import checkpoint
from .density_control import adapt
from .frames import Frames
from .multi_view import check_replicas, check_share
from .process_group import Lost, Team
from .run_folder import Onlooker, RunFolder
from .state import TrainState
from .step import training_step
from .visibility import seen

MOST_FAILURES = 20
"""Non-finite steps in a row after which training stops at the last good state."""
COMPARE_EVERY = 500
"""Steps after which processes that train together make sure that they hold the same scene."""


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
