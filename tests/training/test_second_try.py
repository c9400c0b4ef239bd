"""A second try at stage 1 where limbs have exchanged their tracks: when, with which settings, and of which bits."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.steps import before_each_step
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.config.presets import preset
from scgs_warp.data.dataset import Dataset
from scgs_warp.errors import FrameError, UserError
from scgs_warp.evaluation.image_metrics import psnr
from scgs_warp.training import loop, second_try, torn_spheres
from scgs_warp.training.loop import fit
from scgs_warp.training.state import TrainState, resolve_auto
from scgs_warp.training.torn_spheres import TEAR, may_be_tried_again, second_config, torn_share

TIMES = np.linspace(0.0, 1.0, torn_spheres.INSTANTS)
CONFIG = tiny_config(40, pretrain={"steps": 12, "densify_until": 8, "warm_up": 2, "progressive_every": 1})


@pytest.fixture
def torn(monkeypatch):
    """Take all spheres for torn ones, however few steps each frame gets."""
    monkeypatch.setattr(torn_spheres, "LEAST_VISITS", 1)
    monkeypatch.setattr(torn_spheres, "TORN", 0.0)


def column(x: float, low: float, high: float, count: int) -> np.ndarray:
    """Points of a bar that stands at x, [count, 3]."""
    return np.random.default_rng(int(100 * x) % 97).random((count, 3)) * [0.1, 0.1, high - low] + [x, 0.0, low]


def tracks_of(points: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Tracks [T, N, 3] of points that move along x by ``shifts`` [T, N]."""
    return points + shifts[:, :, None] * [1.0, 0.0, 0.0]


def walker(exchanged: bool) -> np.ndarray:
    """Two legs that swing past each other and back; if exchanged, two quarters of each do, and two stay."""
    points = np.concatenate([column(0.0, 0.0, 1.0, 100), column(1.0, 0.0, 1.0, 100) + np.array([0.0, 0.5, 0.0])])
    swing = np.where(np.arange(200) < 100, 1.0, -1.0) * (0.5 - 0.5 * np.cos(3.0 * math.pi * TIMES[:, None]))
    if exchanged:
        swing = swing * (4.0 * points[:, 2] % 2.0 < 1.0)
    return tracks_of(points, swing)


def test_edges_that_part_count():
    assert torn_share(walker(exchanged=False)) == 0.0, "legs pass each other at a distance"
    assert torn_share(walker(exchanged=True)) > torn_spheres.TORN
    alone = tracks_of(column(0.0, 0.0, 1.0, 100), np.tile(TIMES[:, None], 100))
    assert torn_share(alone) == 0.0, "all move alike"


def test_an_edge_is_torn_from_its_change_in_spacings_on():
    """Two rows of points side by side, one of which slides along: an edge of one spacing grows."""
    row = np.stack([np.arange(20.0), np.zeros(20), np.zeros(20)], 1)
    rows = np.concatenate([row, row + np.array([0.0, 1.0, 0.0])])
    for slide, expected in ((TEAR - 0.2, False), (TEAR + 2.5, True)):
        moves = (
            np.where(np.arange(40) >= 20, slide, 0.0) * TIMES[:, None] * 4.0
        )  # by ``slide`` in a quarter of the time
        quarter = tracks_of(rows, moves)[:5]
        assert (torn_share(quarter) > 0.0) == expected


def test_of_few_or_infinite_spheres_none_is_torn():
    assert torn_share(np.zeros((17, 1, 3))) == 0.0 and torn_share(np.zeros((17, 0, 3))) == 0.0
    assert torn_share(np.zeros((17, 5, 3))) == 0.0, "they coincide"
    tracks = walker(exchanged=True)
    tracks[3, 7, 1] = np.inf
    assert torn_share(tracks) == 0.0


def test_where_a_second_try_may_help():
    config, data = tiny_config(500, pretrain={"steps": 20 * 6}), tiny_dataset(6)
    assert may_be_tried_again(config, data, thin=False)
    assert not may_be_tried_again(config, data, thin=True)
    assert not may_be_tried_again(config, tiny_dataset(7), thin=False), "too few steps for each frame"
    filled = Dataset([dataclasses.replace(frame, alpha=None) for frame in data], folder=data.folder, split="train")
    assert not may_be_tried_again(config, filled, thin=False)
    for change in ({"progressive": True}, {"arap_weight": 0.0}):
        changed = dataclasses.replace(config, pretrain=dataclasses.replace(config.pretrain, **change))
        assert not may_be_tried_again(changed, data, thin=False)
    rigid = dataclasses.replace(config, motion=dataclasses.replace(config.motion, model="static"))
    assert not may_be_tried_again(rigid, data, thin=False), "there is no stage 1"


def test_the_choice_is_made_before_the_first_step(monkeypatch):
    config, data = tiny_config(500, pretrain={"steps": 20 * 6}), tiny_dataset(6)
    assert config.pretrain.arap_by == "auto"
    assert resolve_auto(config, data).pretrain.arap_by == "auto"
    monkeypatch.setattr("scgs_warp.training.state.is_thin", lambda data: True)
    assert resolve_auto(config, data).pretrain.arap_by == "track"
    by_moment = dataclasses.replace(config, pretrain=dataclasses.replace(config.pretrain, arap_by="moment"))
    assert resolve_auto(by_moment, data).pretrain.arap_by == "moment", "what is asked for stays"


def test_the_settings_of_the_second_try():
    first = preset("cpu")
    first = dataclasses.replace(first, pretrain=dataclasses.replace(first.pretrain, progressive_by="fifth"))
    second = second_config(first)
    assert (second.pretrain.progressive, second.pretrain.arap_by) == (True, "moment")
    assert second.pretrain.progressive_by == "frame"
    assert second.pretrain.arap_weight == pytest.approx(10.0 * first.pretrain.arap_weight)
    same = {name: getattr(first.pretrain, name) for name in ("progressive", "progressive_by", "arap_by", "arap_weight")}
    assert dataclasses.replace(second, pretrain=dataclasses.replace(second.pretrain, **same)) == first
    assert preset("paper").pretrain.arap_by == "track"
    assert preset("quick").pretrain.progressive, "which rules a second try out"


def notes_of(run: Path) -> list[str]:
    entries = map(json.loads, (run / "log.jsonl").read_text().splitlines())
    return [entry["note"] for entry in entries if "note" in entry]


def spheres_of(state: TrainState) -> torch.Tensor:
    return state.gaussians.means.detach().clone()


@pytest.mark.parametrize("first_psnr, better", [(20.0, "first"), (15.0, "first"), (14.9, "second")])
def test_the_better_motion_is_kept(first_psnr, better, torn, tmp_path, device, monkeypatch):
    seen, begun, shown = [], [], []

    def score(state, data):
        shown.append(spheres_of(state))
        return first_psnr if len(shown) == 1 else 15.0

    monkeypatch.setattr(second_try, "shown_psnr", score)
    begin_main = TrainState.begin_main

    def look(state):
        begun.append(spheres_of(state))
        begin_main(state)

    monkeypatch.setattr(TrainState, "begin_main", look)
    step = second_try.training_step

    def note(state, frames):
        seen.append((state.step, frames.index_at(state.step, state.config.pretrain.progressive)))
        return step(state, frames)

    monkeypatch.setattr(second_try, "training_step", note)
    fit(CONFIG, tiny_dataset(6), output=tmp_path / "run", device=device)
    assert [number for number, _ in seen] == list(range(12)), "a whole stage 1"
    assert seen[0][1] == 0, "frame by frame from the first one"
    assert len(begun) == 1 and torch.equal(begun[0], shown[{"first": 0, "second": 1}[better]])
    notes = notes_of(tmp_path / "run")
    assert len(notes) == 1 and f"the {better} motion is kept" in notes[0]


def test_without_tears_nothing_is_tried_again(tmp_path, monkeypatch):
    monkeypatch.setattr(torn_spheres, "LEAST_VISITS", 1)
    monkeypatch.setattr(torn_spheres, "TORN", 1.1)
    monkeypatch.setattr(loop, "try_again", lambda *args: pytest.fail("tried again"))
    fit(CONFIG, tiny_dataset(6), output=tmp_path / "auto")
    by_track = dataclasses.replace(CONFIG, pretrain=dataclasses.replace(CONFIG.pretrain, arap_by="track"))
    monkeypatch.setattr(torn_spheres, "TORN", 0.0)
    fit(by_track, tiny_dataset(6), output=tmp_path / "track")
    names = [path.name for path in (tmp_path / "auto").glob("*.safetensors")]
    assert names == ["checkpoint.safetensors"]


def test_views_are_compared_as_they_are_drawn(monkeypatch):
    data = tiny_dataset(6)
    state = TrainState.begin(CONFIG, data, "cpu")
    drawn = torch.stack([state.scene().render(f.camera, f.time).rgb for f in data]).clamp(0, 1)
    true = torch.stack([f.image for f in data])
    assert second_try.shown_psnr(state, data) == pytest.approx(psnr(drawn, true).item(), abs=1e-4)
    monkeypatch.setattr(second_try, "VIEWS", 2)
    assert second_try.shown_psnr(state, data) == pytest.approx(psnr(drawn[[0, 5]], true[[0, 5]]).item(), abs=1e-4)


def test_masks_and_views_of_nothing_count_as_they_should():
    """Pixels outside a mask do not count; a view that shows nothing, and a perfect one, leave the score finite."""
    data = tiny_dataset(6)
    state = TrainState.begin(CONFIG, data, "cpu")
    halves = torch.zeros(48, 48, dtype=torch.bool)
    halves[:, :24] = True
    first = data[0]
    drawn = state.scene().render(first.camera, first.time).rgb.clamp(0, 1)
    masked = dataclasses.replace(first, mask=halves)
    alone = Dataset([masked], folder=data.folder, split="train")
    assert second_try.shown_psnr(state, alone) == pytest.approx(
        psnr(drawn[:, :24], first.image[:, :24]).item(), abs=1e-4
    )
    hidden = dataclasses.replace(first, mask=~halves & halves)
    both = Dataset([masked, hidden], folder=data.folder, split="train")
    assert second_try.shown_psnr(state, both) == second_try.shown_psnr(state, alone)
    perfect = Dataset([dataclasses.replace(first, image=drawn)], folder=data.folder, split="train")
    assert 100.0 < second_try.shown_psnr(state, perfect) < math.inf


@pytest.mark.parametrize("stop_at", [0, 1, 7, 12])
def test_a_run_that_is_stopped_in_the_second_try_gives_the_same_bits(stop_at, torn, tmp_path, device, monkeypatch):
    data = tiny_dataset(6)
    fit(CONFIG, data, output=tmp_path / "whole", device=device)
    whole = (tmp_path / "whole/checkpoint.safetensors").read_bytes()
    again = loop.try_again

    def interrupted(state, frames, go_on):
        if stop_at == 0:  # the process is killed at once
            raise RuntimeError

        def signalled(done):
            if done == stop_at:
                os.kill(os.getpid(), signal.SIGTERM)
            go_on(done)

        return again(state, frames, signalled)

    with monkeypatch.context() as patch, pytest.raises(RuntimeError if stop_at == 0 else KeyboardInterrupt):
        patch.setattr(loop, "try_again", interrupted)
        fit(CONFIG, data, output=tmp_path / "cut", device=device)
    steps: list[int] = []
    with monkeypatch.context() as patch:
        before_each_step(patch, lambda state: steps.append(state.step))
        fit(CONFIG, data, output=tmp_path / "cut", device=device, resume=True)
    assert steps[0] == 12, "the end of stage 1 was saved"
    assert (tmp_path / "cut/checkpoint.safetensors").read_bytes() == whole
    assert notes_of(tmp_path / "cut") == notes_of(tmp_path / "whole")


def test_a_crash_after_the_second_try_repeats_it(torn, tmp_path, monkeypatch):
    data = tiny_dataset(6)
    fit(CONFIG, data, output=tmp_path / "whole")

    def crash(state):
        if state.step == 14:
            raise RuntimeError

    with monkeypatch.context() as patch, pytest.raises(RuntimeError):
        before_each_step(patch, crash)
        fit(CONFIG, data, output=tmp_path / "cut")
    fit(CONFIG, data, output=tmp_path / "cut", resume=True)
    whole, cut = (tmp_path / run for run in ("whole", "cut"))
    assert (cut / "checkpoint.safetensors").read_bytes() == (whole / "checkpoint.safetensors").read_bytes()
    assert notes_of(cut) == notes_of(whole) and len(notes_of(cut)) == 1, "the line is not written twice"


@pytest.mark.parametrize("share, torn", [(0.009, False), (0.011, True)])
def test_only_solid_spheres_are_looked_at(share, torn, monkeypatch):
    """Strays drift apart without end; from which share on spheres are torn."""
    state = TrainState.begin(CONFIG, tiny_dataset(6), "cpu")
    config = dataclasses.replace(CONFIG, pretrain=dataclasses.replace(CONFIG.pretrain, arap_by="auto"))
    with torch.no_grad():
        state.gaussians.opacity_logits[:7] = -9.0
    seen = []
    monkeypatch.setattr(torn_spheres, "torn_share", lambda tracks: seen.append(tracks.shape) or share)
    assert torn_spheres.is_torn(state.gaussians, state.motion, config) == torn
    assert seen == [(torn_spheres.INSTANTS, len(state.gaussians) - 7, 3)]


def test_the_second_try_goes_frame_by_frame_whatever_the_first_did(torn, tmp_path, monkeypatch):
    by_fifths = dataclasses.replace(CONFIG, pretrain=dataclasses.replace(CONFIG.pretrain, progressive_by="fifth"))
    ways, step = [], second_try.training_step

    def noted(state, frames):
        ways.append((state.config.pretrain.progressive_by, frames.config.pretrain.progressive_by))
        return step(state, frames)

    monkeypatch.setattr(second_try, "training_step", noted)
    fit(by_fifths, tiny_dataset(6), output=tmp_path / "run")
    assert ways == [("frame", "frame")] * 12


def test_a_second_try_that_is_not_finite_is_given_up(torn, tmp_path, monkeypatch):
    step = second_try.training_step
    monkeypatch.setattr(
        second_try, "training_step", lambda state, frames: step(state, frames)._replace(failed="the loss")
    )
    fit(CONFIG, tiny_dataset(6), output=tmp_path / "run")
    assert notes_of(tmp_path / "run") == ["the loss is not finite the second time; the first motion is kept"]


def test_exposure_and_points_of_the_kept_motion(torn, tmp_path, monkeypatch):
    """Per-frame colours learn in stage 1, too: those of the other motion would not fit."""
    config = dataclasses.replace(CONFIG, optim=dataclasses.replace(CONFIG.optim, frame_colors=2e-3))
    kept: dict[str, list[TrainState]] = {"shown": [], "main": []}
    scores = iter([10.0, 20.0])
    monkeypatch.setattr(second_try, "shown_psnr", lambda state, data: kept["shown"].append(state) or next(scores))
    begin_main = TrainState.begin_main
    monkeypatch.setattr(TrainState, "begin_main", lambda state: kept["main"].append(state) or begin_main(state))
    fit(config, tiny_dataset(6), output=tmp_path / "run")
    second, main = kept["shown"][1], kept["main"][0]
    assert main is kept["shown"][0] and main is not second
    assert main.exposure is second.exposure and main.exposure_optimizer is second.exposure_optimizer
    assert main.points is second.points and main.colors is second.colors


def test_an_image_that_is_lost_in_the_second_try(torn, tmp_path, monkeypatch):
    def lost(state, frames):
        raise FrameError("train/r_003.png: no such file")

    monkeypatch.setattr(second_try, "training_step", lost)
    with pytest.raises(UserError, match=r"r_003.png: no such file; step 12 is saved: continue with --resume"):
        fit(CONFIG, tiny_dataset(6), output=tmp_path / "run")
