"""The training loop: :func:`fit` prepares a run and repeats training steps until the last one."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, Protocol

from torch import Tensor

from ..config.presets import TrainConfig
from ..config.validation import check
from ..data.dataset import Dataset
from ..data.thumbnails import thumbnails
from ..errors import FrameError, UserError
from ..runtime import environment
from ..runtime.caller_settings import unaffected
from ..runtime.memory import NotEnoughMemory
from ..runtime.progress import Progress, clock, progress
from ..runtime.stop_signals import stop_signals
from ..scene.scene import Scene
from .density_control import control_density, density_due
from .frames import Frames
from .multi_view import StepInterrupted, check_replicas, check_share
from .preflight import refuse_data
from .process_group import ProcessGroup, ProcessLost
from .resuming import as_begun
from .run_folder import ReadOnlyRunFolder, RunFolder, begin_or_resume, end_here
from .second_try import try_again
from .state import StepResult, TrainState
from .stepping import steps_of, take_step
from .turns import add_turns, turns_due
from .vanishing import refuse_empty, shows_nothing

MOST_FAILURES = 20
"""Number of consecutive non-finite steps after which training stops at the last good state."""
COMPARE_EVERY = 500
"""Number of steps between two comparisons of the scenes that the processes of a group hold, and between two checks that
the scene is not empty."""
MOST_EMPTY = 2
"""Number of checks in a row that find the scene empty after which training stops."""


@unaffected
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
    group: ProcessGroup | None = None,
    watcher: Watcher | None = None,
) -> Scene:
    """Train a scene; the run folder holds a resumable checkpoint at any time.

    Args:
        config: the complete configuration: the result of ``config.presets.preset``, possibly changed by ``with_steps``
            or ``from_dict`` of that module.
        data: training frames in world units (``data.load``).
        output: run folder; created if it does not exist.
        device: ``cpu`` or ``cuda``, for all computation.
        test: held-out frames for the curve and the previews; they do not influence the training.
        resume: continue from the checkpoint in ``output``; the result is bit-identical to that of an uninterrupted run.
            If the checkpoint is damaged, the previous one is used; if the run was killed before its first checkpoint,
            training starts from step 0.
        settings: content of ``config.json``; default: the configuration.
        tensorboard: also write event files for TensorBoard to ``output``; the scene stays bit-identical.
        group: the processes that share each step's views (``process_group.join_processes``); ``config.batch`` must be a
            multiple of their number. The first process writes to ``output``; all read from it.
        watcher: gets the state between steps whenever it asks for it; the scene stays bit-identical.

    Returns:
        the scene after the last step, in every process; its ``folder`` is the run directory.

    Raises:
        UserError: the configuration cannot run, a checkpoint does not fit or cannot be written, an image is missing,
            the loss was non-finite repeatedly, TensorBoard is missing, or a process was lost. The last checkpoint is
            intact.
        NotEnoughMemory: one tile of an image needs more memory than is available; the checkpoint is saved.
        KeyboardInterrupt: after Ctrl-C, SIGTERM or the closing of the terminal; the checkpoint is saved.
    """
    # 1. Refuse what cannot run.
    check(config)
    environment.check_device(device)
    check_share(config, group)
    environment.ensure_configured()
    refuse_data(config, data)

    # 2. Open the run folder, and start or resume the state.
    folder_type = RunFolder if group is None or group.first else ReadOnlyRunFolder
    with folder_type(output, config, settings, resume=resume, tensorboard=tensorboard) as folder:
        open_state = partial(begin_or_resume, folder, config, data, device)
        # The first process may have to restore a checkpoint before the others read it.
        state = group.in_turn(open_state) if group is not None and resume else open_state()
        state.group = group
        if resume:
            data = as_begun(data, config, state.config.init_from)
        state.images = {split.split: thumbnails(split) for split in (data, test) if split is not None and len(split)}
        if config.loss.flow > state.config.loss.flow:
            folder.tell("loss.flow has no effect: frames that follow each other show too different things")
        if resume and state.step == config.steps and (group is None or group.first):
            end_here(state, folder)
        frames = Frames(data, state.normalisation, config, device, state.compared_stereo(data))
        folder.start(state.step)

        # 3. Train.
        with progress(config.steps, "training", start=state.step) as bar, stop_signals() as stop:
            folder.tell, frames.interrupted, bar.stop = bar.print, stop.is_set, stop.set
            run = _Run(state, frames, folder, bar, stop, test, watcher)
            try:
                check_replicas(state)
                run.train()
                refuse_empty(state, frames.data, folder.path)
            except ProcessLost as lost:
                raise run.after_loss(lost) from lost
        state.motion.eval()
        scene = state.scene()
        scene.folder = folder.path.absolute()
        return scene


class Watcher(Protocol):
    """Observer of a training, which reads the state between steps and changes nothing."""

    def due(self) -> bool:
        """Return whether the state after the next step is to be shown."""
        ...

    def show(self, state: TrainState) -> None: ...


class _Run:
    """A run under way: its state, and what reads frames for it, records, shows and stops it."""

    def __init__(
        self,
        state: TrainState,
        frames: Frames,
        folder: RunFolder,
        bar: Progress,
        stop: threading.Event,
        test: Dataset | None,
        watcher: Watcher | None,
    ) -> None:
        self.state, self.frames, self.folder = state, frames, folder
        self.bar, self.stop, self.test, self.watcher = bar, stop, test, watcher
        self.steps = steps_of(state, frames, bar.print)

    def train(self) -> None:
        """Repeat training steps until the last one, or until a stop is requested."""
        state, folder, config = self.state, self.folder, self.state.config
        noted = False  # that memory limits the number of Gaussians
        saved_at, empty_checks = time.monotonic(), 0
        while state.step < config.steps:
            # 1. Enter the main stage when stage 1 is over; add the turns of round bodies.
            if state.stage == "pretrain" and state.step >= config.pretrain_steps:
                self._pause()
                self._perhaps_again()
                state.begin_main()
            if turns_due(state, self.frames.data):
                self._pause()
                self._add_turns()

            # 2. Render, compare and update the parameters.
            done = state.step + 1
            tested = self.test is not None and (done % config.evaluate_every == 0 or done == config.steps)
            watched = self.watcher is not None and self.watcher.due()
            results, visible = self._take(looked_at=tested or watched or folder.shows(done))
            for result in results:
                self._count_failure(result)

            # 3. Score held-out frames, before an opacity reset could put a dip into the curve.
            if self.test is not None and tested:
                folder.log_test_psnr(state.scene(), self.test, done)

            # 4. Adaptive density control.
            state.consistent = False
            note = control_density(state, results[-1].size, visible) if density_due(state) else None
            if note is not None and not noted:
                noted = True
                self._note(note, done=state.step)
            state.step = done
            state.consistent = True

            # 5. Show and log.
            if watched and self.watcher is not None:
                self.watcher.show(state)
            for result in results:
                folder.record(state, result, self.bar)

            # 6. Agree with the other processes on stopping, and on the scene; save, stop.
            last = state.step == config.steps
            stopping = self._stopping()
            if last or stopping or state.step % COMPARE_EVERY == 0:
                check_replicas(state)
            if time.monotonic() - saved_at >= config.checkpoint_seconds or last or stopping:
                self._settle()
                state.save(folder.path)
                saved_at = time.monotonic()
            if stopping:
                self._end()
            if state.step % COMPARE_EVERY == 0 and not last:
                empty_checks = empty_checks + 1 if shows_nothing(state.scene(), self.frames.data) else 0
                if empty_checks == MOST_EMPTY:
                    state.save(folder.path)
                    refuse_empty(state, self.frames.data, folder.path)

    def after_loss(self, lost: ProcessLost) -> UserError:
        """Save the state, if it is consistent, after another process has been lost. No further step can be completed,
        but usually none has begun: parameters change only when the gradients of all views are available."""
        state, path = self.state, self.folder.path
        assert state.group is not None
        if state.step == 0:
            return UserError(f"{path}: {lost}; no step was done yet")
        if state.consistent:
            state.save(path)
        saved = state.group.first and state.consistent
        where = f"step {state.step} is saved" if saved else f"reached step {state.step}"
        return UserError(
            f"{path}: {lost}; {where}, continue from the checkpoint with --resume, on one process or any number "
            f"that divides batch {state.config.batch}"
        )

    def _perhaps_again(self) -> None:
        """Train stage 1 a second time if the configuration leaves the choice between both to the result."""
        state, bar = self.state, self.bar
        total, began = state.steps_again, time.monotonic()
        if not total:
            return
        state.save(self.folder.path)
        bar.print(f"step {state.step}: stage 1 is tried a second time")

        def go_on(second: TrainState) -> None:
            left = (time.monotonic() - began) / second.step * (total - second.step)
            bar.beside(second=f"{second.step:,}/{total:,}, {clock(left)} left")
            if self.watcher is not None and self.watcher.due():
                self.watcher.show(second)
            if self._stopping():
                self._end()

        def tell(text: str) -> None:
            bar.beside(second=text)
            if self._stopping():
                self._end()

        try:
            note = try_again(state, self.frames, partial(steps_of, tell=bar.print), go_on, tell)
        except ProcessLost:
            raise
        except StepInterrupted:
            self._end()
        except UserError as error:
            raise self._saved(error) from error
        bar.beside(second=None)
        self._note(note, done=state.step + 1)

    def _add_turns(self) -> None:
        """Add the turns of round bodies to the motion; a run that is stopped here looks for them again when resumed."""

        def tell(text: str) -> None:
            self.bar.beside(turns=text)
            if self.stop.is_set():
                raise StepInterrupted

        self.state.save(self.folder.path)
        try:
            note = add_turns(self.state, self.frames, tell)
        except StepInterrupted:
            self._end()
        except FrameError as error:
            raise self._saved(error) from error
        self.bar.beside(turns=None)
        if note is not None:
            self._note(note, done=self.state.step + 1)

    def _take(self, looked_at: bool) -> tuple[list[StepResult], Tensor | None]:
        """Take a step; save the checkpoint if that fails.

        Args:
            looked_at: the step's result is needed at once.

        Returns:
            The results of all steps that have become known, and the visible Gaussians (``visible_gaussians``).
        """
        results: list[StepResult] = []
        try:
            visible = take_step(self.state, self.frames, self.steps, results, looked_at)
            return results, visible
        except (NotEnoughMemory, StepInterrupted, FrameError) as error:
            self._settle(results)
            self.state.save(self.folder.path)
            if isinstance(error, StepInterrupted):
                self._end()
            if isinstance(error, FrameError):
                raise self._saved(error) from error
            raise  # nothing has changed yet: a machine with more memory can continue

    def _settle(self, known: Sequence[StepResult] = ()) -> None:
        """Wait for the steps in flight, and report them after those ``known``."""
        for result in [*known, *self.steps.settle()]:
            self._count_failure(result)
            self.folder.record(self.state, result, self.bar)

    def _pause(self) -> None:
        """Settle, and let go of the state's tensors, which are to be replaced."""
        self._settle()
        self.steps.release()

    def _count_failure(self, result: StepResult) -> None:
        """Count the dropped steps in a row, and report a dropped step.

        Raises:
            UserError: too many steps in a row were dropped.
        """
        state, path, term = self.state, self.folder.path, result.failed
        if term is None:
            state.failures = 0
            return
        state.failures += 1
        self.bar.print(f"step {result.step}: {term} is not finite; the step was dropped")
        self.folder.log({"step": result.step, "stage": state.stage, "dropped": term})
        if state.failures >= MOST_FAILURES:
            # No dropped step has touched the parameters. A step in flight is part of the saved state.
            for late in self.steps.settle():
                state.step = late.step + 1
            failures, state.failures = state.failures, 0  # a run that goes on may drop as many again
            state.save(path)
            state.failures = failures
            raise UserError(
                f"{path}: {term} was not finite {MOST_FAILURES} times in a row, up to step {state.step}; the "
                "checkpoint holds the last good state; check the data, then --resume, or train again with lower "
                "learning rates and another --output"
            )

    def _note(self, note: str, done: int) -> None:
        """Print what was found, and log it at step ``done``: a resumed run repeats what lies after its checkpoint."""
        self.bar.print(f"step {self.state.step}: {note}")
        self.folder.log({"step": done, "stage": self.state.stage, "note": note})

    def _stopping(self) -> bool:
        """Return whether a process is to stop; all processes get the same answer."""
        asked = self.stop.is_set()
        return asked if self.state.group is None else self.state.group.any(asked)

    def _end(self) -> NoReturn:
        """Stop after the checkpoint has been saved."""
        if self.state.group is not None:
            self.state.group.barrier()  # torchrun ends all processes when one has ended: the first must have saved
        self.bar.print(f"stopped at step {self.state.step}; the checkpoint is saved, continue with --resume")
        raise self.bar.raised or KeyboardInterrupt

    def _saved(self, error: UserError) -> UserError:
        """Add to an error, such as an image that is no longer readable, that the checkpoint has been saved."""
        group = self.state.group
        saved = f"step {self.state.step} is saved: " if group is None or group.first else ""
        return UserError(f"{error}; {saved}continue with --resume")
