"""Training ends where nothing is left."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.errors import UserError
from scgs_warp.scene.scene import Scene
from scgs_warp.training import loop, vanishing
from scgs_warp.training.loop import fit
from scgs_warp.training.state import TrainState
from scgs_warp.training.vanishing import shows_nothing


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
    data = tiny_dataset(4)
    state = TrainState.begin(tiny_config(20, motion={"model": "static"}), data, "cpu")
    with torch.no_grad():
        state.gaussians.opacity_logits.fill_(-20.0)
    assert shows_nothing(state.scene(), data)
    empty = [replace(frame, image=torch.zeros_like(frame.image), alpha=None) for frame in data]
    black = type(data)(empty, folder=data.folder, split=data.split, background="black")
    assert not shows_nothing(state.scene(), black)
