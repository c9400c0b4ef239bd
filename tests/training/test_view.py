"""What a step asks of one view: statistics, the pooled residual, an instant within the film."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.training.frames import Frames
from scgs_warp.training.state import TrainState
from scgs_warp.training.view import Form, noisy_time, prepare


def form_at(step: int, **changes) -> Form:
    """The form of a view at ``step`` of 50, of which 10 are of stage 1."""
    changes["pretrain"] = {"steps": 10, "warm_up": 4, **changes.get("pretrain", {})}
    data = tiny_dataset(3)
    state = TrainState.begin(tiny_config(50, **changes), data, "cpu")
    if step >= 10:
        state.begin_main()
    state.step = step
    return prepare(state, Frames(data, state.normalisation, state.config, "cpu")).form


@pytest.mark.parametrize(("step", "collects"), [(0, True), (9, True), (10, True), (33, True), (34, False), (49, False)])
def test_statistics_are_collected_until_densification_ends(step, collects):
    assert form_at(step, densify={"until": 24}).collects == collects


@pytest.mark.parametrize("stage_1", [True, False])
@pytest.mark.parametrize("stage_2", ["always", "never"])
def test_each_stage_has_its_own_pooled_residual(stage_1, stage_2):
    changes = {"pretrain": {"pooled": stage_1}, "loss": {"pooled": stage_2}}
    assert form_at(5, **changes).pooled == stage_1
    assert form_at(15, **changes).pooled == (stage_2 == "always")


@pytest.mark.parametrize("end", [0.0, 1.0])
def test_noise_does_not_leave_the_film(end):
    config = tiny_config(1000, motion={"time_noise": 0.5}, optim={"network_until": 500})
    states = [SimpleNamespace(config=config, stage_step=0, step=step) for step in range(60)]
    times = [noisy_time(end, state, 11) for state in states]
    assert all(0.0 <= time <= 1.0 for time in times)
    assert 10 < times.count(end) < 50, "about half of the noise points outwards"
