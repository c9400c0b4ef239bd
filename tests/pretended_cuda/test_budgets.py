"""What a frame and a step ask of the host and of the device: contacts, launches and operations, pinned from above."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from pretended_cuda import ledger
from scgs_warp.benchmark.scenes import scene_camera, synthetic_scene, training_data, training_state
from scgs_warp.training.frames import Frames
from scgs_warp.training.step import training_step

SIZE = (64, 48)
FRAME_OPERATIONS, FRAME_LAUNCHES = 58, 15
"""In the recorded frame, all motion included."""
STEP_CONTACTS, STEP_OPERATIONS, STEP_LAUNCHES = 3, 170, 41
ARAP_CONTACTS, ARAP_OPERATIONS, ARAP_LAUNCHES = 5, 185, 44
"""Of a step that carries ARAP."""


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
    assert sum(counts.launches.values()) <= FRAME_LAUNCHES, describe(counts)


def steps_of(arap: bool) -> Callable[[], None]:
    scene = synthetic_scene("control-points", 300, 30, "cuda")
    scene.motion.cache_binding(None)
    data, state = training_data(scene, SIZE), training_state(scene, arap)
    frames = Frames(data, scene.normalisation, state.config, "cuda")

    def step() -> None:
        assert training_step(state, frames).failed is None
        state.step += 1

    return step


@pytest.mark.parametrize(
    ("arap", "contacts", "operations", "launches"),
    [
        (False, STEP_CONTACTS, STEP_OPERATIONS, STEP_LAUNCHES),
        (True, ARAP_CONTACTS, ARAP_OPERATIONS, ARAP_LAUNCHES),
    ],
)
def test_a_training_step(arap, contacts, operations, launches):
    step = steps_of(arap)
    for _ in range(3):
        step()
    with ledger.counted() as counts:
        step()
    assert sum(counts.contacts.values()) <= contacts, describe(counts)
    assert sum(counts.operations.values()) <= operations, describe(counts)
    assert sum(counts.launches.values()) <= launches, describe(counts)
