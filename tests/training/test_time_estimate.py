"""The time that a run takes, estimated from its first steps."""

from __future__ import annotations

import dataclasses

import pytest

from scgs_warp.config.presets import preset, with_steps
from scgs_warp.training.time_estimate import MEASURED, SKIPPED, TimeEstimate


def notes(config, seconds: float, steps: int = 3_000, first: int = 0, again: int = 0) -> dict[int, str]:
    """Take steps of the same length, slow ones at the beginning."""
    now = [0.0]
    estimate = TimeEstimate(config, lambda: now[0])
    found = {}
    for step in range(first + 1, first + steps + 1):
        now[0] += 9.0 if step <= first + SKIPPED else seconds
        note = estimate.note(step, again)
        if note is not None:
            found[step] = note
    return found


def test_one_estimate_after_the_first_steps():
    found = notes(dataclasses.replace(preset("cpu"), half_size=0), 0.05)
    assert list(found) == [MEASURED]
    assert found[MEASURED] == (
        "on this machine, 23,800 more steps (cpu) take 19:50 to 39:40: 50 ms each so far, more as Gaussians are added"
    )


def test_a_second_try_takes_time():
    found = notes(dataclasses.replace(preset("cpu"), half_size=0), 0.05, again=3_000)
    assert "26,800 more steps (cpu, 3,000 of them for a second try at stage 1) take 22:20 to 44:40" in found[MEASURED]


@pytest.mark.parametrize(("first", "range_of"), [(0, "take 1:08 to 3:24"), (4_000, "take 0:28 to 0:56")])
def test_steps_on_halved_images_promise_less(first, range_of):
    """The estimate comes as early, and allows for the larger images to come; later there are none."""
    config = dataclasses.replace(preset("quick"), half_size=1_000)
    found = notes(config, 0.01, first=first)
    assert list(found) == [first + MEASURED] and range_of in found[first + MEASURED]


def test_short_runs_get_none():
    assert notes(with_steps(preset("cpu"), 900), 0.01) == {}
