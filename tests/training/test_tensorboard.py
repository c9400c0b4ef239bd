"""Event files for TensorBoard: the log's curves, once each, whatever happened to the run; and no other bit changed."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Picture

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.apps import train as app
from scgs_warp.errors import UserError
from scgs_warp.training import tensorboard
from scgs_warp.training.loop import fit
from scgs_warp.training.state import TrainState

STEPS = 200


def curves(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """(step, value) of every curve, as TensorBoard itself reads them."""
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    found = events.EventAccumulator(str(folder), size_guidance={"scalars": 0})
    found.Reload()
    return {tag: [(event.step, event.value) for event in found.Scalars(tag)] for tag in found.Tags()["scalars"]}


def pictures(folder: Path) -> dict[str, list]:
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    found = events.EventAccumulator(str(folder), size_guidance={"images": 0})
    found.Reload()
    return {tag: found.Images(tag) for tag in found.Tags()["images"]}


def logged(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """The same from log.jsonl."""
    found: dict[str, list[tuple[int, float]]] = {}
    for line in (folder / "log.jsonl").read_text().splitlines():
        entry = json.loads(line)
        for field, tag in tensorboard.TAGS.items():
            if entry.get(field) is not None:
                found.setdefault(tag, []).append((entry["step"], float(np.float32(entry[field]))))
    return found


def cut(folder: Path, at: int, monkeypatch: pytest.MonkeyPatch, saved: int, **options) -> None:
    """A run whose last checkpoint is of step ``saved`` and that dies at step ``at``."""
    from scgs_warp.training import stepping

    save, step = TrainState.save, stepping.training_step

    def dies(state, frames):
        if state.step == at:
            raise MemoryError("killed")
        return step(state, frames)

    def saves(self, path):
        if self.step <= saved:
            save(self, path)

    with monkeypatch.context() as patch:
        patch.setattr(stepping, "training_step", dies)
        patch.setattr(TrainState, "save", saves)
        config = tiny_config(STEPS, evaluate_every=60, checkpoint_seconds=0.0)
        with pytest.raises(MemoryError):
            fit(config, tiny_dataset(6), test=tiny_dataset(2, split="test"), output=folder, **options)
    time.sleep(1.1)  # event files are told apart by the second they were begun in


def go_on(folder: Path, **options) -> None:
    config = tiny_config(STEPS, evaluate_every=60, checkpoint_seconds=1e9)
    fit(config, tiny_dataset(6), test=tiny_dataset(2, split="test"), output=folder, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    pytest.importorskip("tensorboard")
    go_on(folder, tensorboard=True)
    return folder


def test_the_curves_are_the_logs(whole):
    found = curves(whole)
    assert found == logged(whole)
    assert [step for step, _ in found["loss/total"]] == [50, 100, 150, 200]
    assert [step for step, _ in found["psnr/held_out"]] == [60, 120, 180, 200]
    assert set(found) == set(tensorboard.TAGS.values())


def test_pictures_now_and_then(whole, tmp_path):
    shown = pictures(whole)
    assert [event.step for event in shown["train"]] == list(range(10, STEPS + 1, 10))
    assert [event.step for event in shown["held_out"]] == [60, 120, 180, 200]
    last = shown["held_out"][-1]
    path = tmp_path / "last.png"
    path.write_bytes(last.encoded_image_string)
    pixels = np.asarray(Picture.open(path), np.float64) / 255
    truth = tiny_dataset(2, split="test")[0].image.numpy()
    assert pixels.shape == (48, 96, 3)
    assert np.abs(pixels[:, :48] - truth).max() < 1 / 255, "truth is at the left"
    assert 0 < np.abs(pixels[:, 48:] - truth).mean() < 0.1, "what was learnt is at the right"


def test_it_changes_no_bit(whole, tmp_path):
    go_on(tmp_path)
    assert not list(tmp_path.glob("events*"))
    for name in ("checkpoint.safetensors", "config.json"):
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes()


def test_a_resumed_run_continues_its_curves(whole, tmp_path, monkeypatch):
    """Killed at 130, resumed from 70: what lay between is done, and shown, once."""
    cut(tmp_path, 130, monkeypatch, 70, tensorboard=True)
    assert [step for step, _ in curves(tmp_path)["loss/total"]] == [50, 100]
    go_on(tmp_path, resume=True, tensorboard=True)
    assert len(list(tmp_path.glob("events*"))) == 2
    found, wanted = curves(tmp_path), curves(whole)
    assert found.keys() == wanted.keys()
    for tag, points in wanted.items():
        assert [step for step, _ in found[tag]] == [step for step, _ in points], tag
    for tag in ("loss/total", "psnr/held_out", "size/gaussians"):  # the running mean of psnr/train starts anew
        assert found[tag] == wanted[tag]
    steps = [event.step for event in pictures(tmp_path)["train"]]
    assert steps == list(range(10, STEPS + 1, 10))


def test_what_was_done_without_it_is_shown_too(tmp_path, monkeypatch):
    cut(tmp_path, 130, monkeypatch, 110)
    go_on(tmp_path, resume=True, tensorboard=True)
    assert curves(tmp_path) == logged(tmp_path)
    assert curves(tmp_path)["loss/total"][0][0] == 50


def test_large_pictures_are_shrunk(tmp_path):
    import torch

    pytest.importorskip("tensorboard")
    board = tensorboard.TensorBoard(tmp_path, [], 0, 0.0)
    board.show("wide", torch.zeros(3, 300, 1200), torch.ones(3, 300, 1200), 1)
    board.close()
    (shown,) = pictures(tmp_path)["wide"]
    assert (shown.width, shown.height) == (800, 100)


def test_a_missing_package_is_said_before_anything_is_done(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    monkeypatch.chdir(tmp_path)
    assert app.cli(["--tensorboard", "--device", "cpu"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and 'pip install "scgs-warp[tensorboard]"' in error
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(UserError, match="tensorboard"):
        fit(tiny_config(20), tiny_dataset(2), output=tmp_path / "run", tensorboard=True)
