"""What a step asks of one view: statistics, the pooled residual, the background, an instant within the film."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.training.frames import Frames
from scgs_warp.training.state import TrainState
from scgs_warp.training.view import Choices, Numbers, View, compare, noisy_time, prepare


def view_at(step: int, **changes) -> tuple[TrainState, View]:
    """The view of ``step``, of 50 of which 10 are of stage 1, and the state."""
    data = tiny_dataset(3)
    changes["pretrain"] = {"steps": 10, "warm_up": 4, **changes.get("pretrain", {})}
    state = TrainState.begin(tiny_config(50, **changes), data, "cpu")
    if step >= 10:
        state.begin_main()
    state.step = step
    return state, prepare(state, Frames(data, state.normalisation, state.config, "cpu"))


def choices_at(step: int, **changes) -> Choices:
    """The form of the view of ``step``."""
    return view_at(step, **changes)[1].choices


@pytest.mark.parametrize(("step", "collects"), [(0, True), (9, True), (10, True), (33, True), (34, False), (49, False)])
def test_statistics_are_collected_until_densification_ends(step, collects):
    assert choices_at(step, densify={"until": 24}).collects == collects


@pytest.mark.parametrize("stage_1", [True, False])
@pytest.mark.parametrize("main", ["always", "never"])
def test_each_stage_has_its_own_pooled_residual(stage_1, main):
    changes = {"pretrain": {"pooled": stage_1}, "loss": {"pooled": main}}
    assert choices_at(5, **changes).pooled == stage_1
    assert choices_at(15, **changes).pooled == (main == "always")


@pytest.mark.parametrize("stage_1", [True, False])
@pytest.mark.parametrize(("share", "varied"), [(0.0, []), (0.1, [9, 19, 29, 39]), (0.3, None), (1.0, [*range(40)])])
def test_each_stage_has_its_own_choice_of_the_background(stage_1, share, varied):
    """In the main stage, a share of the steps, evenly spaced, so that nothing comes back beside the subject."""
    changes = {"pretrain": {"random_background": stage_1}, "loss": {"random_background": share}}
    found = [bool(view_at(step, **changes)[1].background.any()) for step in range(50)]
    assert found[:10] == [stage_1] * 10
    random = [step for step, each in enumerate(found[10:]) if each]
    assert varied is None or random == varied
    assert len(random) == share * 40 and set(np.diff(random)) <= {1, 3, 4, 10}


def test_every_step_has_another_background():
    first, second = (view_at(step, loss={"random_background": 1.0})[1].background for step in (20, 21))
    assert not torch.equal(first, second)


@pytest.mark.parametrize("random", [True, False])
def test_black_beside_the_subject_is_seen_on_other_backgrounds_alone(random):
    """A black Gaussian on black changes no image: no gradient would ever remove it."""
    state, view = view_at(12, loss={"random_background": float(random)})
    gaussians = state.gaussians
    with torch.no_grad():
        gaussians.means[:1] = torch.tensor([0.0, 0.0, -1.5])  # below the subject
        gaussians.log_scales[:1] = -2.5
        gaussians.sh_dc[:1] = -0.5 / 0.28209479177387814
        gaussians.opacity_logits[1:] = -20.0
    numbers = Numbers(view.camera, view.background, torch.tensor(view.plan.times), view.plan.weight)
    compare(state, view, numbers, state.stats).loss.backward()
    gradient = gaussians.opacity_logits.grad
    assert gradient is not None and (float(gradient[0]) > 0.0) == random and (float(gradient[0]) != 0.0) == random


@pytest.mark.parametrize("end", [0.0, 1.0])
def test_noise_does_not_leave_the_film(end):
    config = tiny_config(1000, motion={"time_noise": 0.5}, optim={"network_until": 500})
    states = [SimpleNamespace(config=config, stage_step=0, step=step) for step in range(60)]
    times = [noisy_time(end, state, 11) for state in states]
    assert all(0.0 <= time <= 1.0 for time in times)
    assert 10 < times.count(end) < 50, "about half of the noise points outwards"
