"""Stepping: the steps of a run are taken one by one or, on a GPU, without waiting for them (``recorded_step``)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from torch import Tensor

from .density_control import density_due, visible_gaussians
from .frames import Frames
from .recorded_step import RecordedSteps
from .state import StepResult, TrainState
from .step import training_step


class Steps(Protocol):
    """Takes the steps of a state. On a GPU, results become known later (``recorded_step``)."""

    def take(self) -> list[StepResult]:
        """Take the state's next step, and return the results that have become known, in order."""
        ...

    def settle(self) -> list[StepResult]:
        """Wait for the steps in flight, and return their results in order."""
        ...

    def release(self) -> None:
        """Let go of the state's tensors, which are to be replaced. No step may be in flight."""
        ...


class PlainSteps:
    """Steps whose results are known at once."""

    def __init__(self, state: TrainState, frames: Frames) -> None:
        self._state, self._frames = state, frames

    def take(self) -> list[StepResult]:
        return [training_step(self._state, self._frames)]

    def settle(self) -> list[StepResult]:
        return []

    def release(self) -> None:
        pass


def steps_of(
    state: TrainState, frames: Frames, tell: Callable[[str], None] = lambda text: None
) -> PlainSteps | RecordedSteps:
    """Return what takes the steps of a run: on a GPU without waiting for them, if a step has a single view."""
    recorded = state.device.type == "cuda" and state.config.batch == 1 and state.group is None
    return RecordedSteps(state, frames, tell) if recorded else PlainSteps(state, frames)


def take_step(
    state: TrainState, frames: Frames, steps: Steps, results: list[StepResult], settle: bool = False
) -> Tensor | None:
    """Measure visibility if pruning is due, then take a step. The caller must call ``control_density`` afterwards if
    :func:`density_due` was true before.

    Args:
        steps: takes the steps of the state.
        results: list to which the results are appended as they become known, those before an error included.
        settle: wait for the step's own result; where density is due, this is always done.

    Returns:
        The result of :func:`visible_gaussians`.
    """
    due = density_due(state)
    if due:
        results += steps.settle()
    visible = visible_gaussians(state, frames)
    results += steps.take()
    if due or settle:
        results += steps.settle()
    if due:
        steps.release()
    return visible
