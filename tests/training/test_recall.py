"""Scenes that leave every view are drawn back, at the same steps whether the host waits for each or not."""

from __future__ import annotations

import itertools
from functools import partial

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp import optim
from scgs_warp.geometry.normalisation import COMMON_RADIUS
from scgs_warp.ops.adam import adam_step
from scgs_warp.training.frames import Frames
from scgs_warp.training.recall import RecallPeriod, recall, shows_too_little
from scgs_warp.training.recorded_step import RecordedSteps
from scgs_warp.training.state import TrainState
from scgs_warp.training.step import training_step
from scgs_warp.training.vanishing import shows_nothing

AWAY = 10.0
"""Distance, normalised, at which no view shows anything."""


@pytest.fixture(autouse=True)
def _portable_adam(monkeypatch):
    """Let both forms update with the kernel that runs on any device; the one in SIMD rounds differently."""
    monkeypatch.setattr(optim, "adam_step", partial(adam_step, form="plain"))


def begun(device: str, **changes) -> tuple[TrainState, Frames]:
    data = tiny_dataset(4)
    state = TrainState.begin(tiny_config(20, motion={"model": "static"}, **changes), data, device)
    return state, Frames(data, state.normalisation, state.config, device)


def move_away(state: TrainState, frames: Frames) -> None:
    """Move all Gaussians behind some camera and beside the others."""
    cameras = [state.normalisation.apply_camera(camera) for camera in frames.data.cameras]
    outward = torch.stack([camera.position for camera in cameras]).mean(0)
    with torch.no_grad():
        state.gaussians.means.add_((AWAY * outward / outward.norm()).to(state.device))


def distance(state: TrainState) -> float:
    return float(state.gaussians.means.detach().norm(dim=1).mean())


def trained(device: str, recorded: bool, steps: int, away_at: int, **changes) -> tuple[TrainState, list[float]]:
    """Return the state and the distances before each step."""
    state, frames = begun(device, **changes)
    taker, distances = RecordedSteps(state, frames), []
    for step in range(steps):
        if step == away_at:
            move_away(state, frames)
        distances.append(distance(state))
        results = taker.take() if recorded else [training_step(state, frames)]
        assert all(result.failed is None for result in results)
        state.step += 1
    taker.settle()
    return state, distances


@pytest.mark.parametrize("away_at", [0, 3])
def test_gaussians_that_no_view_shows_are_drawn_back_from_the_second_step_on(away_at, device):
    forms = [trained(device, recorded, 12, away_at) for recorded in (False, True)]
    for state, distances in forms:
        moves = [after - before for before, after in itertools.pairwise(distances[away_at:])]
        assert all(abs(move) < 5e-5 for move in moves[:2]), "but for the momentum of earlier steps"
        assert sum(moves[2:]) < -2e-4
        assert state.recalls.begin == away_at + 2
    (plain, before), (recorded, after) = forms
    assert before == after and torch.equal(plain.gaussians.means, recorded.gaussians.means)
    assert plain.recalls == recorded.recalls


def test_a_step_of_several_views_draws_back_at_once():
    state, frames = begun("cpu", batch=2)
    move_away(state, frames)
    assert shows_nothing(state.scene(), frames.data)
    before = distance(state)
    training_step(state, frames)
    assert distance(state) < before
    assert state.recalls == RecallPeriod(), "processes see other views, and keep no period"


def test_a_resumed_run_draws_back_at_the_same_steps(tmp_path):
    state, frames = begun("cpu")
    move_away(state, frames)
    training_step(state, frames)
    state.step += 1
    state.save(tmp_path)
    resumed = TrainState.resume(tmp_path, state.config, frames.data, "cpu")
    assert resumed.recalls == state.recalls == RecallPeriod(2, 50)


def test_the_window_lasts_as_long_as_views_show_nothing():
    period = RecallPeriod().after_nothing_shown(10)
    assert [step for step in range(100) if period.holds(step)] == list(range(12, 60))
    for step in range(11, 71):  # whether the step before is known yet makes no difference
        later = period.after_nothing_shown(step)
        assert later.holds(step + 1) == period.holds(step + 1) or step >= 58
        period = later
    assert period == RecallPeriod(12, 120)
    assert period.after_nothing_shown(118) == RecallPeriod(12, 168)
    assert period.after_nothing_shown(119) == RecallPeriod(121, 169)


def test_only_distant_and_finite_gaussians_are_drawn_back():
    means = torch.tensor([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [float("nan"), 0.0, 0.0]], requires_grad=True)
    drawn = recall(means)
    assert float(drawn.detach()) == pytest.approx(0.2 * (9.0 - COMMON_RADIUS) / 3)
    drawn.backward()
    assert means.grad is not None and means.grad[1, 0] > 0.0
    assert not means.grad[[0, 2]].any()


@pytest.mark.parametrize(("shown", "difference"), [(0.5, 0.5), (0.0, 0.0), (float("nan"), 0.5), (0.0, float("nan"))])
def test_a_view_that_shows_something_or_should_be_empty_draws_nothing_back(shown, difference):
    assert shows_too_little(0.0, 0.5) and not shows_too_little(shown, difference)
