"""Time that a run takes on this machine, estimated from its first steps."""

from __future__ import annotations

import time
from collections.abc import Callable

from ..config.presets import TrainConfig
from ..runtime.progress import clock

MEASURED = 200
"""Number of steps after which the time is estimated."""
SKIPPED = 50
"""Number of steps at the beginning that do not count: kernels are compiled and images read in them."""
SHORTEST = 1_000
"""Number of steps from which a run is long enough for an estimate."""
SLOWEST = 2.0
"""Largest usual ratio of the mean time of a step to that of the first steps, because Gaussians are added. On data of
the zoo it was 0.6 to 2.3."""
SLOWEST_FROM_HALF = 3.0
"""The same where the first steps use the images at half their size."""


class TimeEstimate:
    """Estimate of the time to the last step, made once, from the first steps."""

    def __init__(self, config: TrainConfig, now: Callable[[], float] = time.perf_counter) -> None:
        self.config, self._now = config, now
        self._taken = 0
        self._began = 0.0
        self._done = config.steps < SHORTEST

    def note(self, step: int, again: int = 0) -> str | None:
        """Count a step, and return the estimate after ``MEASURED`` of them; None before and after.

        Args:
            step: number of completed steps of the run.
            again: number of steps of a second try at stage 1 that is to come.
        """
        if self._done:
            return None
        self._taken += 1
        if self._taken == SKIPPED:
            self._began = self._now()
        if self._taken < MEASURED:
            return None
        self._done = True
        each = (self._now() - self._began) / (MEASURED - SKIPPED)
        more = self.config.steps - step + again
        left = each * more
        slowest = SLOWEST if step > self.config.half_size else SLOWEST_FROM_HALF
        twice = f", {again:,} of them for a second try at stage 1" if again else ""
        return (
            f"on this machine, {more:,} more steps ({self.config.preset}{twice}) take {clock(left)} to "
            f"{clock(slowest * left)}: {1000 * each:.0f} ms each so far, more as Gaussians are added"
        )
