"""Refusals before any image is read, and runs that go on beyond their last step."""

from __future__ import annotations

import dataclasses
import json
import shutil

import pytest

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.config.presets import to_dict, with_steps
from scgs_warp.errors import UserError
from scgs_warp.evaluation.run_time import read_seconds, training_seconds
from scgs_warp.scene.scene import Scene
from scgs_warp.storage import checkpoint
from scgs_warp.training.automatic import resolve_auto
from scgs_warp.training.loop import fit
from scgs_warp.training.preflight import CHOSEN_BY_THE_DATA, in_use, refuse_early
from scgs_warp.training.resuming import check_same_configuration
from scgs_warp.training.run_folder import RunFolder


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished run of 40 steps."""
    folder = tmp_path_factory.mktemp("preflight") / "run"
    fit(tiny_config(40), tiny_dataset(6), output=folder)
    return folder


def test_what_can_be_refused_without_the_data(run, tmp_path):
    config = tiny_config(40)
    refuse_early(config, run, True)
    refuse_early(config, tmp_path / "new", False)
    wider = dataclasses.replace(config, motion=dataclasses.replace(config.motion, width=64))
    fewer = dataclasses.replace(config, steps=30)
    small = dataclasses.replace(config, motion=dataclasses.replace(config.motion, nodes=2))
    for settings, folder, resume, expected in (
        (config, run, False, "holds a run already"),
        (wider, run, True, "made with motion.width = 32, now 64"),
        (fewer, run, True, "is at step 40 already, beyond --steps 30"),
        (small, tmp_path / "new", False, "--nodes 2"),
        (config, tmp_path / "none", True, "no such run folder"),
    ):
        with pytest.raises(UserError, match=expected):
            refuse_early(settings, folder, resume)


def test_folders_that_cannot_be_written(tmp_path, monkeypatch):
    config = tiny_config(40)
    (tmp_path / "file").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    for folder, expected in (
        (tmp_path / "file", "file: is no folder; choose another --output"),
        (tmp_path / "link", "link: is no folder"),
        (tmp_path / "file/a/b", "b: cannot be made or written in .*file; choose another --output"),
    ):
        with pytest.raises(UserError, match=expected):
            refuse_early(config, folder, False)
    monkeypatch.setattr("os.access", lambda path, mode: path != tmp_path)
    with pytest.raises(UserError, match="cannot be made or written in"):
        refuse_early(config, tmp_path / "new/run", False)


def test_neighbours_that_the_data_chose_are_left_to_it(run):
    """The run's few steps rule a second try out, so that its checkpoint has ``track``."""
    config = tiny_config(40)
    assert config.pretrain.arap_by == "auto"
    assert checkpoint.read(run, ())[1]["config"]["pretrain"]["arap_by"] == "track"
    refuse_early(config, run, True)


def test_settings_that_the_data_chooses_are_left_to_it():
    """``resolve_auto`` changes only what the early comparison leaves out."""
    config = tiny_config(40)
    cut_out, points = tiny_dataset(4), tiny_dataset(4)
    filled = type(cut_out)(
        [dataclasses.replace(frame, alpha=None) for frame in cut_out], folder=cut_out.folder, split="train"
    )
    points.points = cut_out[0].image.reshape(-1, 3)[:200]
    for data in (cut_out, filled, points):
        resolved = to_dict(resolve_auto(config, data))
        check_same_configuration(resolved, to_dict(config), "test", besides=CHOSEN_BY_THE_DATA)


def test_a_damaged_checkpoint_is_left_to_the_resume(run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run/checkpoint.safetensors").write_bytes(b"damaged")
    refuse_early(tiny_config(40), tmp_path / "run", True)


def test_a_folder_in_use(tmp_path):
    config = tiny_config(20)
    assert not in_use(tmp_path / "run")
    with RunFolder(tmp_path / "run", config, None, resume=False):
        assert in_use(tmp_path / "run")
        with pytest.raises(UserError, match="another trainer is running here"):
            refuse_early(config, tmp_path / "run", False)
    assert not in_use(tmp_path / "run")


def test_a_finished_run_goes_on(run, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    data, config = tiny_dataset(6), tiny_config(40)
    longer = dataclasses.replace(config, steps=60)
    scene = fit(longer, data, output=tmp_path / "run", resume=True)
    assert scene.step == scene.config.steps == 60
    saved = json.loads((tmp_path / "run/config.json").read_text())
    assert saved["steps"] == 60 and saved["densify"]["until"] == config.densify.until, "milestones stay"
    steps = [json.loads(line).get("step") for line in (tmp_path / "run/log.jsonl").read_text().splitlines()]
    assert steps == sorted(steps) and steps[-1] == 60
    again = fit(longer, data, output=tmp_path / "run", resume=True)
    assert again.step == 60
    with pytest.raises(UserError, match="made with freeze = 1, now 2"):
        fit(with_steps(config, 80), data, output=tmp_path / "run", resume=True)


def test_an_extended_run_has_the_same_bits_when_it_is_interrupted(run, tmp_path):
    data, config = tiny_dataset(6), tiny_config(40)
    results = []
    for name, stops in (("straight", (60,)), ("in steps", (50, 60))):
        shutil.copytree(run, tmp_path / name)
        for stop in stops:
            if stop == 50:
                longer = dataclasses.replace(config, steps=60)
                state_stop = stop
                _until(longer, data, tmp_path / name, state_stop)
            else:
                fit(dataclasses.replace(config, steps=60), data, output=tmp_path / name, resume=True)
        results.append((tmp_path / name / "checkpoint.safetensors").read_bytes())
    assert results[0] == results[1]


def _until(config, data, folder, step: int) -> None:
    """Resume, and save the state at ``step`` as an interrupt would."""
    from scgs_warp.training.frames import Frames
    from scgs_warp.training.state import TrainState
    from scgs_warp.training.step import training_step

    state = TrainState.resume(folder, config, data, "cpu")
    frames = Frames(data, state.normalisation, config, "cpu")
    while state.step < step:
        training_step(state, frames)
        state.step += 1
    state.save(folder)


def test_seconds_come_from_the_log_and_else_from_the_metrics(run, tmp_path):
    assert training_seconds(run) == read_seconds(run) > 0
    assert training_seconds(tmp_path) is None
    (tmp_path / "metrics.json").write_text('{"seconds": 12.5}')
    assert training_seconds(tmp_path) == 12.5


def test_the_scene_of_an_unfinished_run_says_so(run, tmp_path):
    assert Scene.load(run).unfinished is None
    shutil.copytree(run, tmp_path / "run")
    _until(dataclasses.replace(tiny_config(40), steps=5_000), tiny_dataset(6), tmp_path / "run", 45)
    scene = Scene.load(tmp_path / "run")
    assert scene.unfinished == "step 45 of 5,000, unfinished"
