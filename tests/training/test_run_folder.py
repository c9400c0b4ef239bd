"""The run folder: its lock, its log, and the read-only form of other processes."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.config.presets import to_dict
from scgs_warp.errors import UserError
from scgs_warp.evaluation.image_metrics import psnr
from scgs_warp.evaluation.run_time import read_seconds
from scgs_warp.training.frames import Frames
from scgs_warp.training.loop import fit
from scgs_warp.training.run_folder import ReadOnlyRunFolder, RunFolder, refuse_existing
from scgs_warp.training.state import TrainState
from scgs_warp.training.step import training_step


def test_two_trainers_cannot_share_a_directory(tmp_path):
    config = tiny_config(20)
    with (
        RunFolder(tmp_path / "run", config, None, resume=False),
        pytest.raises(UserError, match="another trainer"),
        RunFolder(tmp_path / "run", config, None, resume=False),
    ):
        pass


@pytest.mark.parametrize("masked", [True, False])
def test_the_psnr_of_training_is_that_of_valid_pixels(masked, tmp_path, device):
    config = tiny_config(50)
    mask = torch.zeros(48, 48, dtype=torch.bool)
    mask[5:40, :20] = True
    data = tiny_dataset(3)
    frames = [dataclasses.replace(frame, mask=mask if masked else None) for frame in data]
    data = type(data)(frames, folder=Path("masked"), split="train")
    state = TrainState.begin(config, data, device)
    result = training_step(state, Frames(data, state.normalisation, state.config, device))
    state.step = 50
    bar = SimpleNamespace(advance=lambda steps, **shown: None)
    with RunFolder(tmp_path / "run", config, None, resume=False) as folder:
        folder.record(state, result._replace(step=49), bar)
    logged = json.loads((tmp_path / "run/log.jsonl").read_text())["psnr"]
    scores = [float(psnr(result.render[:, seen], result.truth[:, seen])) for seen in (mask.to(device), slice(None))]
    assert abs(scores[0] - scores[1]) > 0.1
    assert logged == pytest.approx(scores[0 if masked else 1], abs=1e-3)


@pytest.mark.parametrize("left", [(), ("previews",), ("previews", ".lock", ".config.json.1.tmp")])
def test_a_trainer_that_ended_before_its_settings_has_no_checkpoint_yet(tmp_path, left):
    """A full disk or a kill at the first file leaves a directory, and --resume must begin there, not refuse."""
    for name in left:
        (tmp_path / name).mkdir() if name == "previews" else (tmp_path / name).touch()
    with RunFolder(tmp_path, tiny_config(50), None, resume=True) as folder:
        assert folder.has_no_checkpoint


def test_a_directory_of_something_else_is_no_run(tmp_path):
    (tmp_path / "photo.jpg").touch()
    with RunFolder(tmp_path, tiny_config(50), None, resume=True) as folder:
        assert not folder.has_no_checkpoint  # so that reading the checkpoint refuses, in one line


def test_a_resumed_log_drops_later_and_damaged_lines(tmp_path):
    config = tiny_config(50)
    with RunFolder(tmp_path / "run", config, None, resume=False) as folder:
        for step in (10, 20, 30):
            folder.log({"step": step, "loss": 0.5})
    with (tmp_path / "run/log.jsonl").open("a") as log:
        log.write('{"step": 4')
    with RunFolder(tmp_path / "run", config, None, resume=True) as folder:
        folder.start(20)
        assert folder.elapsed >= 0.0
    lines = [json.loads(line) for line in (tmp_path / "run/log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [10, 20]
    assert read_seconds(tmp_path / "run") == lines[-1]["seconds"] and read_seconds(tmp_path) is None


def test_only_the_first_process_writes(tmp_path):
    with ReadOnlyRunFolder(tmp_path / "run", tiny_config(50), None, resume=False) as folder:
        folder.start(0)
        folder.log({"step": 1})
    assert not (tmp_path / "run").exists()


def test_a_run_is_not_overwritten(tmp_path):
    refuse_existing(tmp_path, resume=False)
    (tmp_path / "checkpoint.safetensors").touch()
    refuse_existing(tmp_path, resume=True)
    with pytest.raises(UserError, match="holds a run already"):
        refuse_existing(tmp_path, resume=False)


@pytest.mark.parametrize("name", ["config.json", "log.jsonl", "metrics.json", "turntable.mp4", "evaluation"])
def test_files_of_others_are_not_overwritten(name, tmp_path):
    """Nor the scores of a run whose checkpoint was deleted."""
    (tmp_path / name).write_text('{"mine": 1}')
    (tmp_path / ".notes.tmp").write_text("mine")
    for _ in range(2):
        with pytest.raises(UserError, match=f"holds {name}, which training would overwrite"):
            fit(tiny_config(20), tiny_dataset(3), output=tmp_path)
        if name != "config.json":
            (tmp_path / "config.json").write_text(json.dumps(to_dict(tiny_config(20))))
        if name == "log.jsonl":
            break  # the log of a run that was killed before its first checkpoint
    assert (tmp_path / name).read_text() == '{"mine": 1}' and (tmp_path / ".notes.tmp").read_text() == "mine"


def test_what_a_killed_run_left_is_overwritten(tmp_path):
    config = tiny_config(20)
    (tmp_path / "config.json").write_text(json.dumps(to_dict(config)))
    for name in ("log.jsonl", ".notes.tmp", ".log.jsonl.0123abcd.tmp", ".checkpoint.safetensors.tmp"):
        (tmp_path / name).write_text("")
    fit(config, tiny_dataset(3), output=tmp_path)
    assert sorted(path.name for path in tmp_path.glob(".*.tmp")) == [".notes.tmp"]


def test_the_curve_is_the_mean_of_images_from_the_whole_split(tmp_path):
    """Every second of eight images; each is rendered with an error of its own."""
    data, rendered = tiny_dataset(8), []

    def render(camera, time):
        rendered.append(round(7 * time))
        image = next(frame.image for frame in data if frame.time == time)
        return SimpleNamespace(rgb=image + 0.1 * (1.0 + time))

    modes = []
    motion = SimpleNamespace(eval=lambda: modes.append("eval"), train=lambda: modes.append("train"))
    with RunFolder(tmp_path / "run", tiny_config(50), None, resume=False) as folder:
        folder.log_test_psnr(SimpleNamespace(render=render, motion=motion), data, 30)
    assert rendered == [0, 2, 4, 6] and modes == ["eval", "train"]
    logged = json.loads((tmp_path / "run/log.jsonl").read_text())
    expected = sum(-20 * math.log10(0.1 * (1 + k / 7)) for k in rendered) / 4
    assert logged["step"] == 30 and logged["test_psnr"] == pytest.approx(expected, abs=0.01)  # colours end at 1


def test_the_curve_counts_valid_pixels(tmp_path):
    """The error is 0.1 where the pixel is valid, 0.6 elsewhere."""
    mask = torch.zeros(48, 48, dtype=torch.bool)
    mask[5:40, :20] = True
    frame = dataclasses.replace(tiny_dataset(1)[0], image=torch.full((48, 48, 3), 0.3), mask=mask)
    data = type(tiny_dataset(1))([frame], folder=Path("masked"), split="test")
    shown = frame.image + torch.where(mask, 0.1, 0.6)[..., None]
    motion = SimpleNamespace(eval=lambda: None, train=lambda: None)
    scene = SimpleNamespace(render=lambda camera, time: SimpleNamespace(rgb=shown), motion=motion)
    with RunFolder(tmp_path / "run", tiny_config(50), None, resume=False) as folder:
        folder.log_test_psnr(scene, data, 30)
    assert json.loads((tmp_path / "run/log.jsonl").read_text())["test_psnr"] == pytest.approx(20.0, abs=1e-3)
