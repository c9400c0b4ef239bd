"""Scenes that leave every view are drawn back, and training ends where nothing is left."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.errors import UserError
from scgs_warp.geometry.normalisation import COMMON_RADIUS
from scgs_warp.scene.scene import Scene
from scgs_warp.training import loop, vanishing
from scgs_warp.training.frames import Frames
from scgs_warp.training.loop import fit
from scgs_warp.training.recorded_step import RecordedSteps
from scgs_warp.training.state import TrainState
from scgs_warp.training.step import training_step
from scgs_warp.training.vanishing import recall, shows_nothing

AWAY = 10.0
"""Distance, normalised, at which no view shows anything."""


def state_away(device: str = "cpu", **changes) -> tuple[TrainState, Frames]:
    """A static scene whose Gaussians all lie behind some camera and beside the others."""
    data = tiny_dataset(4)
    state = TrainState.begin(tiny_config(20, motion={"model": "static"}, **changes), data, device)
    cameras = [state.normalisation.apply_camera(camera) for camera in data.cameras]
    outward = torch.stack([camera.position for camera in cameras]).mean(0)
    with torch.no_grad():
        state.gaussians.means.add_((AWAY * outward / outward.norm()).to(device))
    return state, Frames(data, state.normalisation, state.config, device)


def test_gaussians_that_no_view_shows_are_drawn_back():
    state, frames = state_away()
    assert shows_nothing(state.scene(), frames.frames)
    before = state.gaussians.means.detach().norm(dim=1).mean()
    training_step(state, frames)
    assert state.gaussians.means.detach().norm(dim=1).mean() < before


def test_steps_that_the_host_does_not_wait_for_find_out_later(device):
    state, frames = state_away(device)
    before, steps = state.gaussians.means.detach().norm(dim=1).mean(), RecordedSteps(state, frames)
    for _ in range(2):  # the results of the second are not known before the third
        steps.take()
        state.step += 1
    assert state.gaussians.means.detach().norm(dim=1).mean() == before
    for _ in range(2):
        (result,) = [*steps.settle(), *steps.take()][-1:]
        assert result.failed is None
        state.step += 1
    assert state.gaussians.means.detach().norm(dim=1).mean() < before


def test_only_distant_and_finite_gaussians_are_drawn_back():
    means = torch.tensor([[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [float("nan"), 0.0, 0.0]], requires_grad=True)
    drawn = recall(means, torch.zeros(2, 2), torch.tensor(0.5))
    assert drawn is not None and float(drawn.detach()) == pytest.approx(0.2 * (9.0 - COMMON_RADIUS) / 3)
    drawn.backward()
    assert means.grad is not None and means.grad[1, 0] > 0.0
    assert not means.grad[[0, 2]].any()


@pytest.mark.parametrize(("alpha", "difference"), [(0.5, 0.5), (0.0, 0.0)])
def test_a_view_that_shows_something_or_should_be_empty_draws_nothing_back(alpha, difference):
    assert recall(torch.full((1, 3), 9.0), torch.full((2, 2), alpha), torch.tensor(difference)) is None


def test_training_ends_where_nothing_is_left(tmp_path, monkeypatch):
    for module in (loop, vanishing):
        monkeypatch.setattr(module, "shows_nothing", lambda scene, data: True)
    monkeypatch.setattr(loop, "COMPARE_EVERY", 10)
    with pytest.raises(UserError, match=r"nothing is left of the scene at step 20\b.*the checkpoint is kept"):
        fit(tiny_config(100), tiny_dataset(4), output=tmp_path / "run")
    assert Scene.load(tmp_path / "run").step == 20


def test_a_scene_that_is_empty_at_the_end_is_not_evaluated(tmp_path, monkeypatch):
    monkeypatch.setattr(vanishing, "shows_nothing", lambda scene, data: True)
    for resume in (False, True):
        with pytest.raises(UserError, match="nothing is left of the scene at step 20"):
            fit(tiny_config(20), tiny_dataset(4), output=tmp_path / "run", resume=resume)
    assert Scene.load(tmp_path / "run").step == 20


def test_images_that_are_empty_need_nothing():
    state, frames = state_away()
    data = frames.frames
    empty = [replace(frame, image=torch.zeros_like(frame.image), alpha=None) for frame in data]
    black = type(data)(empty, folder=data.folder, split=data.split, background="black")
    assert not shows_nothing(state.scene(), black)
