"""Training steps on a GPU that the host does not wait for.

A step's numbers (camera, times, learning rates) go to the device in one copy; the device itself decides whether the
step is committed (``ops.step_outcome``), and the host reads the outcome while the next step runs. Lists of pairs have a
fixed capacity: a step that needs more changes nothing, nor does its successor, and both are repeated with more room.
Steps that consist of the same operations are recorded as a CUDA graph and replayed.

The results are those of ``step.training_step``, which still takes the steps that cannot be taken this way: steps with
several views, with refined cameras, with affine colours of frames, steps that compare flow, steps with debug checks,
steps whose lists exceed the memory, and steps that may draw back Gaussians (``recall``). On a CPU the same operations
run one by one; the tests use this.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Hashable
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels.types import STEP_FINE, STEP_GRADIENT, STEP_HALTED, STEP_LOSS, TILE_SIZE
from ..ops.binning_cuda import MAX_ROOM, bytes_within
from ..runtime import debug, memory
from ..runtime.cuda_graph import GraphMemory
from .depth import depth_applies
from .flow import flow_applies
from .frames import Frames
from .recall import shows_too_little
from .recorded_update import Kind, RecordedUpdate
from .state import StepResult, TrainState
from .step import set_rates, training_step
from .view import View, may_recall, prepare

PAIRS_PER_GAUSSIAN = 4
"""Ratio of the capacity to the number of Gaussians before the number of pairs of any step is known."""
CAPACITY_FACTOR = 1.5
"""Ratio of a new capacity to the largest number of pairs seen: views differ in their number of pairs."""
CAPACITY_STEP = 1 << 16
"""Number of pairs to a multiple of which the capacity is rounded up."""
SLOT_BYTES = 8 + 64
"""Number of bytes that a pair takes in addition to the lists of an image without gradients."""
RETRY_AFTER = 20, 500, 500
"""Numbers of steps from each failed recording of one kind of steps to the next attempt. After one more failure, that
kind is not recorded again. The cause may be temporary: autograd still holds the graph of an earlier step, or another
program compiles the same kernels."""


class _Step(NamedTuple):
    """A step that can be repeated."""

    number: int
    view: View
    numbers: Tensor
    key: Hashable


class _Submitted(NamedTuple):
    """A step in flight."""

    step: _Step
    kind: Kind
    picture: Tensor
    report: Tensor
    """On the host once ``done``."""
    done: torch.cuda.Event | None


class RecordedSteps:
    """Steps of one run whose results arrive one step late.

    Attributes: ``recordings`` (number of graphs recorded), ``repeats`` (number of steps repeated for lack of room),
    ``failure`` (error of a kind of steps whose last recording failed, else None).
    """

    def __init__(self, state: TrainState, frames: Frames, tell: Callable[[str], None] = lambda text: None) -> None:
        """
        Args:
            tell: prints a line for the user.
        """
        self._state, self._frames, self._tell = state, frames, tell
        self.capacity, self.recordings, self.repeats = 0, 0, 0
        self._errors: dict[Hashable, str] = {}
        self._failures: Counter[Hashable] = Counter()
        self._records_from: dict[Hashable, int] = {}
        self._told: set[bool] = set()
        self._most_pairs = 0
        self._memory = GraphMemory()
        self._pending: deque[_Submitted] = deque()
        self._update: RecordedUpdate | None = None

    @property
    def failure(self) -> str | None:
        return next(reversed(self._errors.values()), None)

    def take(self) -> list[StepResult]:
        """Start the state's next step; return the results of the steps that have become known, in order.

        Raises:
            FrameError: the frame's file is no longer readable; nothing has changed.
        """
        state = self._state
        if not self._fits():
            results = self.settle()
            self.release()
            return [*results, training_step(state, self._frames)]
        results = self.settle() if state.motion.refresh_due(state.stage_step, state.config) else []
        set_rates(state)
        view = prepare(state, self._frames)
        update = self._bound()
        self._submit(update, _Step(state.step, view, update.numbers(view), update.key(view)))
        while len(self._pending) > 1:
            results += self._oldest()
        return results

    def settle(self) -> list[StepResult]:
        """Wait for all steps, and return their results in order."""
        results: list[StepResult] = []
        while self._pending:
            results += self._oldest()
        return results

    def release(self) -> None:
        """Let go of the state's tensors, which are to be replaced. The results of all steps must be known."""
        assert not self._pending, "a step is in flight"
        self._update, self.capacity = None, 0

    def _fits(self) -> bool:
        """Return True if the present step can be taken without the host, as far as is known beforehand."""
        state = self._state
        ready = state.motion.takes_time_tensor and not state.refines_cameras and not len(state.exposure)
        if state.stage == "main":
            ready = ready and not flow_applies(state.stage_step, state.config)
        if not ready or debug.enabled() or may_recall(state):
            return False
        if self.capacity > 0 and self._update is not None and self._update.holds():
            return True
        seen = int(CAPACITY_FACTOR * self._most_pairs)
        wanted = max(seen or PAIRS_PER_GAUSSIAN * len(state.gaussians), 1)
        return self.capacity >= wanted or self._make_room(wanted)

    def _compares_depth(self) -> bool:
        state = self._state
        applies = state.stage == "main" and depth_applies(state.stage_step, state.config)
        return applies and self._frames.depths.available

    def _make_room(self, pairs: int) -> bool:
        """Set the capacity for ``pairs``; return False if it exceeds the index range or the memory."""
        capacity = min(-(-max(pairs, 1) // CAPACITY_STEP) * CAPACITY_STEP, MAX_ROOM)
        largest = max((max(view.width, view.height) for view in self._frames.views), default=1)
        tiles = (-(-largest // TILE_SIZE)) ** 2
        need = bytes_within(capacity, len(self._state.gaussians), tiles) + SLOT_BYTES * capacity
        need *= 2 if self._compares_depth() else 1  # lists of their own, of a smaller image
        if pairs > capacity or not memory.fits(need, self._state.device):
            return False
        self.capacity = capacity
        if self._update is not None:
            self._update.forget_recordings()
        return True

    def _bound(self) -> RecordedUpdate:
        """Return the update of the state's present tensors."""
        if self._update is None or not self._update.holds():
            assert not self._pending, "tensors may be replaced only when all steps are known"
            self._update = None  # frees the old tensors before the new buffers are made
            self._update, self._most_pairs = RecordedUpdate(self._state, self._memory), 0
        return self._update

    def _submit(self, update: RecordedUpdate, step: _Step) -> None:
        before = update.recordings
        waits = step.number < self._records_from.get(step.key, 0)
        record = self._failures[step.key] <= len(RETRY_AFTER) and not waits
        if record:
            update.failure = None
        report, picture, kind = update.take(step.view, step.numbers, step.key, self.capacity, record)
        if update.recordings > before:
            self.recordings += update.recordings - before
            self._errors.pop(step.key, None)
        elif record and update.failure is not None:
            self._note_failure(update.failure, step)
        done, device = None, self._state.device
        if device.type == "cuda":
            host = torch.empty(report.shape, dtype=report.dtype, pin_memory=True)
            report = host.copy_(report, non_blocking=True)
            done = torch.cuda.Event()
            done.record(torch.cuda.current_stream(device))
        for group in kind.updated:
            group.steps += 1
        self._pending.append(_Submitted(step, kind, picture, report, done))

    def _note_failure(self, failure: str, step: _Step) -> None:
        self._failures[step.key] += 1
        self._errors[step.key], count = failure, self._failures[step.key]
        last = count > len(RETRY_AFTER)
        if not last:
            self._records_from[step.key] = step.number + RETRY_AFTER[count - 1]
        if count > 1 and last not in self._told:  # once each; most causes have passed by the second attempt
            self._told.add(last)
            again = "" if last else f"; next attempt in {RETRY_AFTER[count - 1]} steps"
            reason = failure.splitlines()[0]
            self._tell(f"some steps are not recorded as a CUDA graph, so they take longer: {reason}{again}")

    def _oldest(self) -> list[StepResult]:
        """Wait for the oldest step and return its result. If it lacked room, repeat it and all later ones instead."""
        first = self._pending[0]
        if first.done is not None:
            first.done.synchronize()
        outcome, pairs, loss, l1, ssim, regulariser, shown = first.report.tolist()
        self._most_pairs = max(self._most_pairs, int(pairs))
        if outcome == STEP_HALTED:
            return self._repeat(int(pairs))
        self._pending.popleft()
        if shows_too_little(shown, l1):
            self._state.recalls = self._state.recalls.after_nothing_shown(first.step.number)
        failed = None if outcome == STEP_FINE else _name(int(outcome), first.kind.names)
        if failed is not None:
            _take_back(first)
        step, view, camera = first.step.number, first.step.view, first.step.view.camera
        scalars = torch.tensor(loss), torch.tensor(l1), torch.tensor(ssim), regulariser
        size = camera.width, camera.height
        return [StepResult(step, *scalars, first.picture, view.truth, view.mask, failed, size)]

    def _repeat(self, pairs: int) -> list[StepResult]:
        """Take all pending steps, none of which has changed anything, again with room for ``pairs``."""
        again, update, state = list(self._pending), self._update, self._state
        assert update is not None
        self._pending.clear()
        self.repeats += len(again)
        for submitted in again:
            _take_back(submitted)
        update.outcome.halted.zero_()
        if self._make_room(int(CAPACITY_FACTOR * pairs)):
            for submitted in again:
                self._submit(update, submitted.step)
            return []
        self.release()
        present, results = state.step, []
        for submitted in again:
            state.step = submitted.step.number
            results.append(training_step(state, self._frames))
        state.step = present
        return results


def _take_back(submitted: _Submitted) -> None:
    """Undo the count of a step that was not committed."""
    for group in submitted.kind.updated:
        group.steps -= 1


def _name(outcome: int, gradients: list[str]) -> str:
    """Return the name of the term that is not finite."""
    if outcome < STEP_GRADIENT:
        return "image loss" if outcome == STEP_LOSS else "regulariser"
    return f"gradient of {gradients[outcome - STEP_GRADIENT]}"
