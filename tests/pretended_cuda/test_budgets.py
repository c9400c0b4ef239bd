"""What a frame and a step ask of the host and of the device: contacts, launches and operations, pinned from above."""

from __future__ import annotations

import pytest
import torch

from pretended_cuda import ledger
from scgs_warp.benchmark.scenes import scene_camera, synthetic_scene, training_data, training_state
from scgs_warp.training.frames import Frames
from scgs_warp.training.recorded_step import RecordedSteps
from scgs_warp.training.recorded_update import RecordedUpdate
from scgs_warp.training.state import TrainState

SIZE = (64, 48)
FRAME_OPERATIONS, FRAME_LAUNCHES, FRAME_SORTS = 12, 13, 2
"""In the recorded frame, all motion included; the launches beside those of the sorts."""
STEP_CONTACTS, STEP_OPERATIONS = 1, 3
"""Of a recorded step, beside the replay."""
RECORDED_OPERATIONS, RECORDED_LAUNCHES = 109, 48
"""In the recorded step. The copies of gradients, one for each parameter here, are few launches on a GPU."""
ARAP_OPERATIONS, ARAP_LAUNCHES = 118, 53
"""In the recorded step that carries ARAP."""


def describe(counts: ledger.Ledger) -> str:
    return "\n".join((*counts.lines(), str(dict(counts.operations)), str(dict(counts.launches))))


@pytest.mark.parametrize("where", ["cpu", "cuda"])
def test_the_host_waits_once_for_a_frame_and_never_to_start_one(where):
    scene = synthetic_scene("control-points", 300, 30, "cuda")
    camera = scene_camera(scene, SIZE).to(where)
    for instant in range(4):
        scene.render(camera, 0.1 * instant)
    frames, color = scene.frame_graph(), torch.zeros(3)
    assert frames.recordings == 1 and frames.failure is None
    view = scene.normalisation.apply_camera(camera)
    with ledger.counted() as counts:
        pending = [frames.submit(view, 0.1 * instant, color) for instant in range(3)]
    assert not counts.contacts, describe(counts)
    assert counts.launches == {"graph": 3}
    assert sum(counts.operations.values()) <= 3 * 12, describe(counts)
    with ledger.counted() as counts:
        for frame in pending:
            frames.finish(frame)
    assert [kind for kind, _ in counts.contacts] == ["event.synchronize"], describe(counts)
    with ledger.counted() as counts:
        scene.render(camera, 0.55)
    assert sum(counts.contacts.values()) == 1, describe(counts)


def test_operations_of_a_recorded_frame():
    scene = synthetic_scene("control-points", 300, 30, "cuda")
    camera = scene_camera(scene, SIZE)
    for instant in range(4):
        scene.render(camera, 0.1 * instant)
    with ledger.counted() as counts:
        scene.frame_graph().draw_steps()
    assert not counts.contacts, describe(counts)
    assert sum(counts.operations.values()) <= FRAME_OPERATIONS, describe(counts)
    assert counts.launches.pop("radix_sort_pairs") <= FRAME_SORTS, describe(counts)
    assert sum(counts.launches.values()) <= FRAME_LAUNCHES, describe(counts)


def recorded_steps(arap: bool) -> tuple[TrainState, RecordedSteps]:
    scene = synthetic_scene("control-points", 300, 30, "cuda")
    scene.motion.cache_binding(None)
    data, state = training_data(scene, SIZE), training_state(scene, arap)
    return state, RecordedSteps(state, Frames(data, scene.normalisation, state.config, "cuda"))


@pytest.mark.parametrize("arap", [False, True])
def test_a_training_step(arap):
    state, steps = recorded_steps(arap)
    for _ in range(8):  # all images are on the device then
        assert all(result.failed is None for result in steps.take())
        state.step += 1
    assert steps.recordings == 1 and steps.failure is None and steps.repeats == 0
    with ledger.counted() as counts:
        (result,) = steps.take()
    assert result.step == state.step - 1 and result.failed is None, "the result comes one step late"
    assert [kind for kind, _ in counts.contacts] == ["event.synchronize"], describe(counts)
    assert sum(counts.contacts.values()) == STEP_CONTACTS, describe(counts)
    assert counts.launches == {"graph": 1}, describe(counts)
    assert sum(counts.operations.values()) <= STEP_OPERATIONS, describe(counts)


@pytest.mark.parametrize(
    ("arap", "operations", "launches"),
    [(False, RECORDED_OPERATIONS, RECORDED_LAUNCHES), (True, ARAP_OPERATIONS, ARAP_LAUNCHES)],
)
def test_operations_of_a_recorded_step(arap, operations, launches, monkeypatch):
    bodies = []
    inner = RecordedUpdate._step

    def counting(self, *arguments):
        with ledger.counted() as counts:
            found = inner(self, *arguments)
        bodies.append(counts)
        return found

    monkeypatch.setattr(RecordedUpdate, "_step", counting)
    state, steps = recorded_steps(arap)
    for _ in range(2):
        steps.take()
        state.step += 1
    counts = bodies[-1]
    assert not counts.contacts, describe(counts)
    assert sum(counts.operations.values()) <= operations, describe(counts)
    assert sum(counts.launches.values()) <= launches, describe(counts)
