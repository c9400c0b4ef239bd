"""Training in one call: what it returns, what it prints, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

import scgs_warp
from helpers.tiny import tiny_config, tiny_dataset, write_dnerf
from helpers.torch_settings import SETTINGS
from scgs_warp.errors import UserError
from scgs_warp.storage import checkpoint
from scgs_warp.training.one_call import chosen_device

TINY = {
    "steps": 60,
    "device": "cpu",
    "motion__nodes": 16,
    "motion__layers": 3,
    "motion__width": 32,
    "motion__skip": 2,
    "init_points": 300,
}


def test_a_folder_becomes_a_scene_and_a_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    calls: list[tuple[str, int, int]] = []
    write_dnerf(tmp_path / "blobs")
    scene = scgs_warp.train("blobs", progress=lambda *call: calls.append(call), **TINY)
    assert scene.step == 60 and scene.folder == tmp_path / "runs/blobs-cpu" and capsys.readouterr().out == ""
    assert [call for call in calls if call[0] == "training"] == [("training", step, 60) for step in range(1, 61)]
    metrics = json.loads((scene.folder / "metrics.json").read_text())
    assert metrics["images"] == 3 and metrics["seconds"] > 0 and (scene.folder / "contact_sheet.png").is_file()
    assert scgs_warp.Scene.load(scene.folder).gaussian_count == scene.gaussian_count
    with pytest.raises(UserError, match="holds a run already"):
        scgs_warp.train("blobs", **TINY)
    longer = scgs_warp.train("blobs", resume=True, progress=False, **TINY)
    assert longer.step == 60
    film = scene.turntable("film.gif", frames=3, size=32)
    assert film == Path("film.gif") and film.stat().st_size > 300
    assert scene.turntable(tmp_path / "still", frames=2, size=32, time=0.5, show="alpha").is_dir()


def test_a_data_set_in_memory_trains(tmp_path, capsys):
    scene = scgs_warp.train(tiny_dataset(6), output=tmp_path / "run", **TINY)
    assert scene.folder == tmp_path / "run"
    assert scene.step == 60 and "data: 6 frames of 48 x 48" in capsys.readouterr().out


@pytest.mark.parametrize("last", [25, 60])
def test_an_error_of_the_progress_function_stops_a_run_that_goes_on(last, tmp_path, monkeypatch):
    """It is raised once the step is saved; and neither it nor the directory of the program matters to the run."""
    data, calls = tiny_dataset(6), []
    monkeypatch.chdir(tmp_path)

    def told(work, done, total):
        calls.append(done)
        if done == 10:
            (tmp_path / "elsewhere").mkdir()
            monkeypatch.chdir(tmp_path / "elsewhere")
        if done == last:
            raise KeyboardInterrupt("enough")

    with pytest.raises(KeyboardInterrupt, match="enough"):
        scgs_warp.train(data, output="run", progress=told, **TINY)
    assert calls == list(range(1, last + 1)) and not any((tmp_path / "elsewhere").iterdir())
    assert checkpoint.read(tmp_path / "run", ())[1]["step"] == last
    stopped = scgs_warp.train(data, output=tmp_path / "run", progress=False, resume=True, **TINY)
    whole = scgs_warp.train(data, output=tmp_path / "whole", progress=False, **TINY)
    assert all(torch.equal(value, stopped.tensors()[name]) for name, value in whole.tensors().items())


@pytest.mark.parametrize("setting", SETTINGS)
def test_what_the_caller_has_set_for_torch_changes_nothing(setting, tmp_path):
    data = tiny_dataset(4, 24)
    plain = scgs_warp.fit(tiny_config(30), data, output=tmp_path / "plain")
    with SETTINGS[setting]():
        changed = scgs_warp.fit(tiny_config(30), data, output=tmp_path / "changed")
    assert changed.folder == tmp_path / "changed"
    assert all(torch.equal(value, changed.tensors()[name]) for name, value in plain.tensors().items())


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"preset": "fast"}, "preset is 'fast'"),
        ({"steps": 2.5}, "steps is 2.5"),
        ({"motion__speed": 3}, "motion.speed"),
        ({"device": "gpu"}, "device is 'gpu'"),
        ({"data": "nowhere"}, "nowhere: no such folder"),
    ],
)
def test_mistakes_are_named_before_anything_is_written(arguments, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=expected):
        scgs_warp.train(**{"data": tiny_dataset(2), "progress": False, **arguments})
    assert not (tmp_path / "runs").exists()


def test_a_device_of_torch_is_a_device():
    assert chosen_device(torch.device("cpu")) == "cpu"


def test_a_film_of_impossible_size(tmp_path):
    from helpers.fake_scene import FakeScene
    from scgs_warp.visualization.films import turntable

    for options in ({"frames": 0}, {"frames": 10**9}, {"size": 5}, {"fps": 0}):
        with pytest.raises(UserError, match="give 1 to 100,000"):
            turntable(FakeScene(), tmp_path / "film.mp4", **options)  # type: ignore[arg-type]
    for options in ({"frames": 1.5}, {"frames": "3"}, {"size": 64.5}, {"fps": "fast"}, {"time": "noon"}):
        with pytest.raises(UserError, match="give whole numbers of frames and pixels, and numbers"):
            turntable(FakeScene(), tmp_path / "film.mp4", **options)  # type: ignore[arg-type]
    for time in (3, -0.1, float("nan")):
        with pytest.raises(UserError, match="give a time from 0 to 1"):
            turntable(FakeScene(), tmp_path / "film.mp4", time=time)  # type: ignore[arg-type]
