"""The loop: it learns, and it survives. That it gives the same bits is test_same_bits.py."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import threading
from pathlib import Path

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.errors import UserError
from scgs_warp.evaluation.evaluate import evaluate
from scgs_warp.evaluation.image_metrics import psnr
from scgs_warp.scene.scene import Scene
from scgs_warp.storage import checkpoint
from scgs_warp.training import step, stepping
from scgs_warp.training.frames import Frames
from scgs_warp.training.gaussian_density import RESET_OPACITY
from scgs_warp.training.loop import fit
from scgs_warp.training.run_folder import RunFolder
from scgs_warp.training.state import TrainState
from scgs_warp.training.step import training_step

MODELS = ["control-points", "per-gaussian", "hexplane", "static"]


def checkpoint_bytes(folder: Path) -> bytes:
    return (folder / "checkpoint.safetensors").read_bytes()


@pytest.mark.parametrize("model", MODELS)
def test_every_motion_model_learns(model, tmp_path, device):
    data, test = tiny_dataset(), tiny_dataset(4, split="test")
    config = tiny_config(200, motion={"model": model})
    scene = fit(config, data, output=tmp_path / "run", device=device, test=test)
    black = sum(float(psnr(torch.zeros_like(f.image), f.image)) for f in test) / len(test)
    assert evaluate(scene, test)["psnr"] > black + 4.0
    log = [json.loads(line) for line in (tmp_path / "run/log.jsonl").read_text().splitlines()]
    steps = [entry["step"] for entry in log if "loss" in entry]
    assert steps == [50, 100, 150, 200]
    assert any("test_psnr" in entry for entry in log)


@pytest.mark.parametrize("batch", [1, 2])
def test_the_log_shows_the_regulariser(batch, tmp_path, monkeypatch):
    """Each line has the last value since the line before, as one step in five carries ARAP."""
    values = []
    step = stepping.training_step

    def recorded(state, frames):
        result = step(state, frames)
        values.append(result.regulariser)
        return result

    monkeypatch.setattr(stepping, "training_step", recorded)
    config = tiny_config(100, batch=batch, pretrain={"silhouette": 0.0}, loss={"arap_until": 100})
    fit(config, tiny_dataset(4), output=tmp_path / "run")
    log = [json.loads(line) for line in (tmp_path / "run/log.jsonl").read_text().splitlines()]
    rows = {entry["step"]: entry["regulariser"] for entry in log if "loss" in entry}
    assert rows.keys() == {50, 100} and all(value > 0.0 for value in rows.values())
    assert rows == {step: next(filter(None, reversed(values[:step]))) for step in (50, 100)}
    assert sum(value > 0.0 for value in values) <= 20


@pytest.mark.parametrize(("weight", "noted"), [(1.0, True), (0.0, False)])
def test_flow_without_effect_is_noted(weight, noted, tmp_path, capsys):
    fit(tiny_config(20, loss={"flow": weight}), tiny_dataset(4), output=tmp_path / "run")
    said = capsys.readouterr()
    assert ("loss.flow has no effect" in said.out + said.err) is noted


def test_the_curve_does_not_show_opacity_resets(tmp_path, monkeypatch):
    """They fall on the same round steps."""
    looks = []
    monkeypatch.setattr(
        RunFolder,
        "log_test_psnr",
        lambda _, scene, test, step: looks.append((step, float(scene.gaussians.opacities().detach().max()))),
    )
    schedule = {"until": 45, "opacity_reset_every": 20, "every": 10}
    config = tiny_config(60, motion={"model": "static"}, densify=schedule, evaluate_every=20)
    fit(config, tiny_dataset(6), output=tmp_path / "run", test=tiny_dataset(2, split="test"))
    assert [step for step, _ in looks] == [20, 40, 60]
    assert all(most > 2 * RESET_OPACITY for _, most in looks), looks


def test_a_trained_scene_renders_the_same_bits_after_loading(tmp_path, device):
    data = tiny_dataset(6)
    scene = fit(tiny_config(40), data, output=tmp_path / "run", device=device)
    scene.freeze_binding()
    loaded = Scene.load(tmp_path / "run", device=device)
    for frame in data:
        assert torch.equal(scene.render(frame.camera, frame.time).rgb, loaded.render(frame.camera, frame.time).rgb)
    assert loaded.step == 40
    posed = loaded.gaussians_at(0.3)
    assert posed.means.shape == (loaded.gaussian_count, 3)
    assert loaded.control_points_at(0.3).shape == (loaded.control_point_count, 3)


def test_a_run_that_is_stopped_by_sigterm_resumes_to_the_same_bits(tmp_path, monkeypatch):
    data = tiny_dataset(6)
    step = stepping.training_step

    def interrupting(state, frames):
        if state.step == 20:
            os.kill(os.getpid(), signal.SIGTERM)
        return step(state, frames)

    monkeypatch.setattr(stepping, "training_step", interrupting)
    with pytest.raises(KeyboardInterrupt):
        fit(tiny_config(60), data, output=tmp_path / "run")
    monkeypatch.undo()
    fit(tiny_config(60), data, output=tmp_path / "run", resume=True)
    fit(tiny_config(60), data, output=tmp_path / "whole")
    assert checkpoint_bytes(tmp_path / "run") == checkpoint_bytes(tmp_path / "whole")


def test_a_stop_does_not_wait_for_the_other_views_of_a_step(tmp_path, monkeypatch):
    data, view_of, seen = tiny_dataset(6), step.one_view, []

    def interrupting(state, frames, view, stats):
        seen.append((state.step, view))
        if seen[-1] == (20, 2):
            os.kill(os.getpid(), signal.SIGTERM)
        return view_of(state, frames, view, stats)

    monkeypatch.setattr(step, "one_view", interrupting)
    with pytest.raises(KeyboardInterrupt):
        fit(tiny_config(30, batch=5), data, output=tmp_path / "run")
    monkeypatch.undo()
    assert seen[-1] == (20, 2) and Scene.load(tmp_path / "run").step == 20
    fit(tiny_config(30, batch=5), data, output=tmp_path / "run", resume=True)
    fit(tiny_config(30, batch=5), data, output=tmp_path / "whole")
    assert checkpoint_bytes(tmp_path / "run") == checkpoint_bytes(tmp_path / "whole")


def test_a_bad_frame_is_dropped_and_named(tmp_path, capsys):
    data = tiny_dataset(6)
    data[2].image[5, 5, 0] = float("nan")
    scene = fit(tiny_config(60), data, output=tmp_path / "run")
    log = [json.loads(line) for line in (tmp_path / "run/log.jsonl").read_text().splitlines()]
    dropped = [entry for entry in log if "dropped" in entry]
    assert dropped and all(entry["dropped"] == "image loss" for entry in dropped)
    assert 8 <= len(dropped) <= 12, "one frame of six, 60 steps"
    assert all(bool(torch.isfinite(value).all()) for value in scene.tensors().values())


@pytest.mark.parametrize(("owner", "name"), [("gaussians", "sh_rest"), ("motion", "network.head.weight")])
def test_a_bad_gradient_changes_nothing_and_is_named(owner, name, device):
    data = tiny_dataset(6)
    config = tiny_config(60, pretrain={"steps": 0}, freeze=0)
    state = TrainState.begin(config, data, device)
    frames = Frames(data, state.normalisation, config, device)
    for _ in range(3):
        assert training_step(state, frames).failed is None
        state.step += 1
    assert state.motion_optimizer is not None

    def everything() -> dict[str, torch.Tensor]:
        tensors = {**state.scene().tensors(), **state.gaussian_optimizer.tensors("a")}
        tensors |= state.motion_optimizer.tensors("b") if state.motion_optimizer is not None else {}
        return {key: value.detach().clone() for key, value in tensors.items()}

    def poison(gradient: torch.Tensor) -> torch.Tensor:
        gradient = gradient.clone()
        gradient.view(-1)[-1] = float("inf")
        return gradient

    before = everything()
    hook = getattr(state, owner).get_parameter(name).register_hook(poison)
    assert training_step(state, frames).failed == f"gradient of {name}"
    after = everything()
    assert before.keys() == after.keys() and all(torch.equal(before[key], after[key]) for key in before)
    hook.remove()
    assert training_step(state, frames).failed is None
    assert not torch.equal(everything()["b.network.head.weight.exp_avg"], before["b.network.head.weight.exp_avg"])


def test_repeated_failure_stops_at_the_last_good_state(tmp_path):
    data = tiny_dataset(3)
    for frame in data:
        frame.image[:] = float("inf")
    with pytest.raises(UserError, match="not finite 20 times"):
        fit(tiny_config(60), data, output=tmp_path / "run")
    some = tiny_dataset(3)
    some[0].image[:] = float("inf")  # one dropped step does not end the run again
    fit(tiny_config(60), some, output=tmp_path / "run", resume=True)
    _, metadata = checkpoint.read(tmp_path / "run", ())
    assert metadata["step"] == 60 and metadata["failures"] <= 1


def test_a_run_that_ends_where_it_is_is_finished(tmp_path):
    data = tiny_dataset(3)
    fit(tiny_config(60), data, output=tmp_path / "run")
    longer = dataclasses.replace(tiny_config(60), steps=80)
    state = TrainState.resume(tmp_path / "run", longer, data, "cpu")
    state.save(tmp_path / "run")  # as an interrupted run of 80 steps leaves it
    assert Scene.load(tmp_path / "run").unfinished == "step 60 of 80, unfinished"
    fit(tiny_config(60), data, output=tmp_path / "run", resume=True)
    assert Scene.load(tmp_path / "run").unfinished is None


@pytest.mark.parametrize("field", ["optim.network", "densify.grad_threshold"])
def test_rates_and_thresholds_may_be_zero(field, tmp_path):
    section, name = field.split(".")
    scene = fit(tiny_config(60, **{section: {name: 0.0}}), tiny_dataset(3), output=tmp_path / "run")
    assert scene.step == 60


def test_what_cannot_be_trained_or_resumed_is_refused(tmp_path):
    data = tiny_dataset(3)
    config = tiny_config(20)
    with pytest.raises(UserError, match="data is 'tiny'; give a data set"):
        fit(config, "tiny", output=tmp_path / "a")  # type: ignore[arg-type]
    for other in ("cpu", None, {"steps": 3}):
        with pytest.raises(UserError, match=r"config is .*; give a TrainConfig"):
            fit(other, data, output=tmp_path / "a")  # type: ignore[arg-type]
    with pytest.raises(UserError, match="no frames"):
        fit(config, type(data)([], folder=Path("empty"), split="train"), output=tmp_path / "a")
    fit(config, data, output=tmp_path / "run")
    with pytest.raises(UserError, match="holds a run already"):
        fit(config, data, output=tmp_path / "run")
    with pytest.raises(UserError, match="made with batch = 1, now 2"):
        fit(dataclasses.replace(config, batch=2), data, output=tmp_path / "run", resume=True)
    with pytest.raises(UserError, match="is at step 20 already, beyond --steps 10; give at least 20"):
        fit(dataclasses.replace(config, steps=10), data, output=tmp_path / "run", resume=True)
    with pytest.raises(UserError, match="no such run"):
        fit(config, data, output=tmp_path / "new", resume=True)
    assert not (tmp_path / "new").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other/photo.jpg").touch()
    with pytest.raises(UserError, match="no checkpoint"):
        fit(config, data, output=tmp_path / "other", resume=True)
    path = tmp_path / "run/checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(UserError, match="damaged"):
        Scene.load(tmp_path / "run")
    with pytest.raises(UserError, match="no such run"):
        Scene.load(tmp_path / "nowhere")


def test_without_a_first_stage(tmp_path):
    config = tiny_config(30, pretrain={"steps": 0})
    scene = fit(config, tiny_dataset(4), output=tmp_path / "run")
    places = scene.control_points_at(0.0)
    assert float(places.std(0).min()) > 0.05, "control points must not coincide"


def test_the_background_is_one(tmp_path):
    data = type(tiny_dataset(1))(list(tiny_dataset(3)), folder=Path("white"), split="train", background="white")
    with pytest.raises(UserError, match="loaded on white"):
        fit(tiny_config(20), data, output=tmp_path / "run")


def test_max_gaussians_bounds_the_model(tmp_path):
    config = tiny_config(150, densify={"max_gaussians": 320, "grad_threshold": 1e-9})
    scene = fit(config, tiny_dataset(6), output=tmp_path / "run")
    assert 100 < scene.gaussian_count <= 320


def test_fit_runs_in_a_thread(tmp_path):
    """Signals belong to the main thread; elsewhere training works without them."""
    errors = []

    def work():
        try:
            fit(tiny_config(12), tiny_dataset(3), output=tmp_path / "run")
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert not errors
