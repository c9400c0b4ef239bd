"""Recordings of steps that fail: they are tried again, and a kind that cannot be recorded holds no other up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
import torch

from helpers.filmed_blobs import film, with_depth
from helpers.steps import PRETENDED, begin
from scgs_warp.runtime.cuda_graph import CudaGraph, GraphMemory
from scgs_warp.training import recorded_step
from scgs_warp.training.recorded_step import RecordedSteps
from scgs_warp.training.recorded_update import RecordedUpdate


def recordings_that_fail(device, monkeypatch, fails: Callable[[int, Any], bool], steps_taken: int, **changes):
    """Take steps of which some recordings fail, by the number of attempts and the kind; return what took them, the
    steps of the attempts, and the lines."""
    record, attempts, said = RecordedUpdate._record, [], []
    state, frames = begin(device, **changes)

    def refuse(self, key, body):
        if not fails(len(attempts), key):
            return record(self, key, body)
        attempts.append(state.step)
        self.failure = "no capture\nof this"
        self.forget_recordings()

    monkeypatch.setattr(RecordedUpdate, "_record", refuse)
    monkeypatch.setattr(recorded_step, "RETRY_AFTER", (12, 14))
    steps = RecordedSteps(state, frames, said.append)
    for _ in range(steps_taken):
        steps.take()
        state.step += 1
    steps.settle()
    return steps, attempts, said


def test_a_failed_recording_is_tried_again(device, monkeypatch):
    """The cause may have passed: one failure must not slow the whole run."""
    failed: Counter[Any] = Counter()

    def twice(number: int, key: Any) -> bool:
        failed[key] += 1
        return failed[key] <= 2

    steps, attempts, said = recordings_that_fail(device, monkeypatch, twice, 90)
    assert steps.failure is None and steps.recordings >= 1
    assert len(attempts) >= 2 and attempts[1] - attempts[0] >= 12
    assert len(said) == 1 and "no capture; next attempt in 14 steps" in said[0] and "\n" not in said[0]


def test_a_recording_that_fails_once_is_not_worth_a_line(device, monkeypatch):
    steps, attempts, said = recordings_that_fail(device, monkeypatch, lambda number, key: number < 1, 40)
    assert steps.failure is None and steps.recordings >= 1 and len(attempts) == 1 and said == []


def test_recordings_that_keep_failing_are_given_up(device, monkeypatch):
    steps, attempts, said = recordings_that_fail(device, monkeypatch, lambda number, key: True, 90)
    assert steps.failure is not None and steps.recordings == 0
    assert len(attempts) == (1 + len(recorded_step.RETRY_AFTER)) * len(steps._failures)
    assert len(said) == 2 and "next attempt" in said[0] and said[1].endswith("no capture")


def test_a_kind_that_cannot_be_recorded_does_not_keep_others_from_it(device, monkeypatch):
    """Steps that compare depth fail; the other half is recorded in the end."""
    model = {"pretrain": {"steps": 0}, "motion": {"model": "static"}, "loss": {"depth": 0.5}}
    size = 48, 48
    steps, _, _ = recordings_that_fail(
        device, monkeypatch, lambda number, key: size in key, 90, data=with_depth(film(6, 48)), **model
    )
    assert sum(steps._failures.values()) > 1 + len(recorded_step.RETRY_AFTER)
    assert steps._update is not None and len(steps._update._recorded) >= 1


@pytest.mark.skipif(PRETENDED, reason="the pretended device's captures cannot become invalid")
def test_a_capture_that_fails_midway_leaves_room_for_the_next(device):
    """The memory of an invalid capture cannot be used again on some versions of torch."""
    if device != "cuda":
        pytest.skip("needs a GPU")
    memory, tensor = GraphMemory(), torch.ones(8, device=device)
    with pytest.raises(RuntimeError):
        CudaGraph(lambda: (tensor * 2).sum().item(), tensor.device, warm_ups=0, memory=memory)
    memory.renew()
    graph = CudaGraph(lambda: tensor * 3, tensor.device, warm_ups=1, memory=memory)
    assert torch.equal(graph.replay(), tensor * 3)
