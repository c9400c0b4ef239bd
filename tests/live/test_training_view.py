"""The page that follows a training: what it shows in both stages, what it costs, and that it changes no bit."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.export.page_data import unpack
from scgs_warp.live import training_view as module
from scgs_warp.live.training_view import TrainingView
from scgs_warp.training.loop import fit

MODELS = ("control-points", "static", "hexplane")
STEPS = 40


class Shown:
    """What a SceneView would show."""

    def __init__(self) -> None:
        self.wanted = threading.Event()
        self.wanted.set()
        self.scenes: list[tuple[dict[str, Any], dict[str, np.ndarray]]] = []
        self.said: list[str] = []

    def publish(self, content: bytes, status: str) -> None:
        self.scenes.append(unpack(content))
        self.said.append(status)

    def say(self, status: str) -> None:
        self.said.append(status)


@pytest.mark.parametrize("model", MODELS)
def test_it_shows_both_stages_and_changes_no_bit(model, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "LEAST_PAUSE", 0.0)
    monkeypatch.setattr(module, "COST", 1e9)
    config, shown = tiny_config(STEPS, motion={"model": model}), Shown()
    data = tiny_dataset(6)
    fit(config, data, output=tmp_path / "alone")
    fit(config, data, output=tmp_path / "watched", watcher=TrainingView(shown, STEPS))
    names = [tmp_path / run / "checkpoint.safetensors" for run in ("alone", "watched")]
    assert names[0].read_bytes() == names[1].read_bytes()
    if model == "hexplane":
        assert not shown.scenes and "no control points" in shown.said[-1], "said, and trained all the same"
        return
    assert shown.said[-1].startswith(f"step {STEPS} of {STEPS}")
    facts, columns = shown.scenes[-1]
    assert facts["gaussians"] > 100 and facts["nodes"] == len(columns.get("rest0", ()))
    assert (facts["nodes"] > 0) == (model == "control-points")
    if model == "control-points":
        spheres, columns = shown.scenes[config.pretrain_steps - 2]
        assert spheres["neighbors"] == 1 and spheres["nodes"] == spheres["gaussians"] == len(columns["mean0"])
        assert np.array_equal(columns["node0"], np.arange(spheres["nodes"]))
        np.testing.assert_allclose(columns["rest0"], columns["mean0"], atol=5e-5)


def test_it_costs_nothing_without_a_page_and_little_with_one(monkeypatch):
    shown, now = Shown(), [100.0]
    view = TrainingView(shown, 10, clock=lambda: now[0])

    def draw(scene: Any) -> Any:
        now[0] += 0.5
        raise module.UserError("nothing to see")

    monkeypatch.setattr(module, "training_page", draw)
    state = type("State", (), {"scene": lambda self: None})()
    assert view.due()
    view.show(state)
    assert not view.due()
    now[0] += 24.9
    assert not view.due(), "half a second is two percent of 25"
    now[0] += 0.2
    assert view.due()
    shown.wanted.clear()
    assert not view.due()
