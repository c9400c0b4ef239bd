"""Act on a run between its steps."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from scgs_warp.training.loop import PlainSteps
from scgs_warp.training.recorded_step import RecordedSteps
from scgs_warp.training.state import TrainState


def before_each_step(monkeypatch: pytest.MonkeyPatch, act: Callable[[TrainState], None]) -> None:
    """Call ``act`` before each step of ``fit``, when all steps before it are known."""
    for kind in (PlainSteps, RecordedSteps):

        def acting(self, take=kind.take):
            results = self.settle()
            act(self._state)
            return [*results, *take(self)]

        monkeypatch.setattr(kind, "take", acting)
