"""A second try at stage 1: when, with which settings, and of which bits."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import signal
from pathlib import Path

import pytest
import torch

from helpers.steps import before_each_step
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.config.presets import preset
from scgs_warp.data.dataset import Dataset
from scgs_warp.errors import FrameError, UserError
from scgs_warp.evaluation.image_metrics import psnr
from scgs_warp.training import loop, second_try, second_try_config, stepping
from scgs_warp.training.automatic import resolve_auto
from scgs_warp.training.loop import fit
from scgs_warp.training.second_try_config import may_be_tried_again
from scgs_warp.training.state import TrainState

CONFIG = tiny_config(40, pretrain={"steps": 12, "densify_until": 8, "warm_up": 2, "progressive_every": 1})


@pytest.fixture
def tried(monkeypatch):
    """Let stage 1 be tried again, however few steps each frame gets."""
    monkeypatch.setattr(second_try_config, "LEAST_VISITS", 1)


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
    monkeypatch.setattr("scgs_warp.training.automatic.is_thin", lambda data: True)
    assert resolve_auto(config, data).pretrain.arap_by == "track"
    by_moment = dataclasses.replace(config, pretrain=dataclasses.replace(config.pretrain, arap_by="moment"))
    assert resolve_auto(by_moment, data).pretrain.arap_by == "moment", "what is asked for stays"


def test_the_settings_of_the_second_try():
    first = preset("cpu")
    first = dataclasses.replace(first, pretrain=dataclasses.replace(first.pretrain, progressive_by="fifth"))
    second = second_try_config.second_config(first, turning=False)
    assert (second.pretrain.progressive, second.pretrain.arap_by) == (True, "moment")
    assert second.pretrain.progressive_by == "frame"
    assert second.pretrain.arap_weight == pytest.approx(10.0 * first.pretrain.arap_weight)
    same = {name: getattr(first.pretrain, name) for name in ("progressive", "progressive_by", "arap_by", "arap_weight")}
    assert dataclasses.replace(second, pretrain=dataclasses.replace(second.pretrain, **same)) == first
    turned = second_try_config.second_config(first, turning=True).pretrain
    assert turned == dataclasses.replace(
        first.pretrain, arap_by="moment", arap_weight=second.pretrain.arap_weight, warm_up=0
    )
    assert preset("paper").pretrain.arap_by == "track"
    assert preset("quick").pretrain.progressive, "which rules a second try out"


def notes_of(run: Path) -> list[str]:
    entries = map(json.loads, (run / "log.jsonl").read_text().splitlines())
    return [entry["note"] for entry in entries if "note" in entry]


def spheres_of(state: TrainState) -> torch.Tensor:
    return state.gaussians.means.detach().clone()


@pytest.mark.parametrize("first_psnr, better", [(20.0, "first"), (15.0, "first"), (14.95, "first"), (14.85, "second")])
def test_the_better_motion_is_kept(first_psnr, better, tried, tmp_path, device, monkeypatch):
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
    take = second_try.take_step

    def note(state, frames, *rest, **options):
        seen.append((state.step, frames.index_at(state.step, state.config.pretrain.progressive)))
        return take(state, frames, *rest, **options)

    monkeypatch.setattr(second_try, "take_step", note)
    fit(CONFIG, tiny_dataset(6), output=tmp_path / "run", device=device)
    assert [number for number, _ in seen] == list(range(12)), "a whole stage 1"
    assert seen[0][1] == 0, "frame by frame from the first one"
    assert len(begun) == 1 and torch.equal(begun[0], shown[{"first": 0, "second": 1}[better]])
    notes = notes_of(tmp_path / "run")
    assert len(notes) == 1 and f"the {better} motion is kept" in notes[0]


TORN = second_try.TORN


@pytest.mark.parametrize(
    ("torn", "loss", "whole", "better"),
    [
        ((2.0 * TORN, TORN), 0.5, True, "second"),
        ((2.0 * TORN, TORN), 0.95, True, "second"),
        ((2.0 * TORN, TORN), 1.05, True, "first"),  # the views are shown clearly worse
        ((2.0 * TORN, TORN), 0.5, False, "first"),  # what falls apart may tear
        ((2.0 * TORN, 1.6 * TORN), 0.5, True, "first"),  # hardly less
        ((0.95 * TORN, 0.1 * TORN), 0.3, True, "first"),  # hardly torn, and the views are shown worse
        ((0.2 * TORN, 0.07 * TORN), 0.2, True, "second"),  # the views are shown alike
        ((0.2 * TORN, 0.09 * TORN), 0.05, True, "first"),  # firmer, but not far less torn
        ((0.2 * TORN, 0.07 * TORN), 0.2, False, "first"),
        ((2.0 * TORN, 9.0 * TORN), -0.2, True, "second"),  # a gain decides alone
    ],
)
def test_a_motion_that_tears_a_body_less_is_kept(torn, loss, whole, better, tried, tmp_path, monkeypatch):
    scores, tears, kept = iter([15.0, 15.0 - loss]), iter(torn), []
    monkeypatch.setattr(second_try, "shown_psnr", lambda state, data: kept.append(spheres_of(state)) or next(scores))
    monkeypatch.setattr(second_try, "torn_by", lambda state: next(tears))
    monkeypatch.setattr(second_try, "is_one_piece", lambda data: whole)
    begun, begin_main = [], TrainState.begin_main
    monkeypatch.setattr(TrainState, "begin_main", lambda state: begun.append(spheres_of(state)) or begin_main(state))
    fit(CONFIG, tiny_dataset(6), output=tmp_path / "run")
    assert torch.equal(begun[0], kept[{"first": 0, "second": 1}[better]])
    (note,) = notes_of(tmp_path / "run")
    assert f"the {better} motion is kept" in note
    assert (f"it tears the body less ({torn[1]:.3f}, not {torn[0]:.3f})" in note) == (better == "second" and loss > 0)


def test_tearing_is_that_of_the_solid_spheres(device):
    """A faint stray that flies away does not tear the body."""
    state = TrainState.begin(CONFIG, tiny_dataset(6), device)
    with torch.no_grad():
        state.gaussians.opacity_logits[:] = 2.0
        state.gaussians.opacity_logits[3] = -6.0
    moves = torch.linspace(0.0, 1.0, second_try.INSTANTS)[:, None, None] * torch.tensor([0.2, 0.1, 0.0])
    flies = moves.repeat(1, len(state.gaussians), 1)
    flies[:, 3] *= 100.0
    state.motion.translations = lambda means, times: flies.to(means.device)
    assert second_try.torn_by(state) < 1e-6
    assert state.motion.training
    with torch.no_grad():
        state.gaussians.opacity_logits[3] = 2.0
    assert second_try.torn_by(state) > 1e-4


def test_tearing_does_not_depend_on_the_number_of_spheres(device):
    """Two halves of a body slide along each other."""
    state, random = TrainState.begin(CONFIG, tiny_dataset(6), device), torch.Generator().manual_seed(0)
    times = torch.linspace(0.0, 1.0, second_try.INSTANTS)[:, None, None]
    torn = []
    for count in (600, 4800):
        places = torch.rand(count, 3, generator=random).to(device)
        state.gaussians.means = torch.nn.Parameter(places)
        state.gaussians.opacity_logits = torch.nn.Parameter(torch.full((count,), 2.0, device=device))
        upper = (places[:, 2:] > 0.5).cpu() * torch.tensor([1.0, 0.0, 0.0])
        state.motion.translations = lambda means, _, upper=upper: (times * upper).to(means.device)
        torn.append(second_try.torn_by(state))
    assert torn[0] > 0.02 and torn[1] == pytest.approx(torn[0], rel=0.15)


def test_what_is_asked_for_is_not_tried_again(tried, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "try_again", lambda *args: pytest.fail("tried again"))
    for name in ("track", "moment"):
        asked = dataclasses.replace(CONFIG, pretrain=dataclasses.replace(CONFIG.pretrain, arap_by=name))
        fit(asked, tiny_dataset(6), output=tmp_path / name)


def test_the_steps_of_a_second_try_are_counted_until_it_is_made(tried):
    data = tiny_dataset(6)
    state = TrainState.begin(CONFIG, data, "cpu")
    assert state.steps_again == 12
    state.begin_main()
    assert state.steps_again == 0
    asked = dataclasses.replace(CONFIG, pretrain=dataclasses.replace(CONFIG.pretrain, arap_by="track"))
    assert TrainState.begin(asked, data, "cpu").steps_again == 0


def test_the_estimate_of_the_time_counts_the_second_try(tried, tmp_path, monkeypatch):
    counted = []
    monkeypatch.setattr(
        "scgs_warp.training.time_estimate.TimeEstimate.note", lambda self, step, again=0: counted.append((step, again))
    )
    fit(CONFIG, tiny_dataset(6), output=tmp_path / "run")
    assert counted == [(step, 12 if step <= 12 else 0) for step in range(1, 41)]


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
def test_a_run_that_is_stopped_in_the_second_try_gives_the_same_bits(stop_at, tried, tmp_path, device, monkeypatch):
    data = tiny_dataset(6)
    fit(CONFIG, data, output=tmp_path / "whole", device=device)
    whole = (tmp_path / "whole/checkpoint.safetensors").read_bytes()
    again = loop.try_again

    def interrupted(state, frames, steps_of, go_on, tell):
        if stop_at == 0:  # the process is killed at once
            raise RuntimeError

        def signalled(second):
            if second.step == stop_at:
                os.kill(os.getpid(), signal.SIGTERM)
            go_on(second)

        return again(state, frames, steps_of, signalled, tell)

    with monkeypatch.context() as patch, pytest.raises(RuntimeError if stop_at == 0 else KeyboardInterrupt):
        patch.setattr(loop, "try_again", interrupted)
        fit(CONFIG, data, output=tmp_path / "cut", device=device)
    steps: list[tuple[str, int]] = []
    with monkeypatch.context() as patch:
        before_each_step(patch, lambda state: steps.append((state.config.pretrain.arap_by, state.step)))
        fit(CONFIG, data, output=tmp_path / "cut", device=device, resume=True)
    expected = [("moment", step) for step in range(12)] + [("auto", step) for step in range(12, 40)]
    assert steps == expected, "the end of stage 1 was saved"
    assert (tmp_path / "cut/checkpoint.safetensors").read_bytes() == whole
    assert notes_of(tmp_path / "cut") == notes_of(tmp_path / "whole")


def test_a_crash_after_the_second_try_repeats_it(tried, tmp_path, monkeypatch):
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


def test_the_second_try_goes_frame_by_frame_whatever_the_first_did(tried, tmp_path, monkeypatch):
    by_fifths = dataclasses.replace(CONFIG, pretrain=dataclasses.replace(CONFIG.pretrain, progressive_by="fifth"))
    ways, take = [], second_try.take_step

    def noted(state, frames, *rest, **options):
        ways.append((state.config.pretrain.progressive_by, frames.config.pretrain.progressive_by))
        return take(state, frames, *rest, **options)

    monkeypatch.setattr(second_try, "take_step", noted)
    fit(by_fifths, tiny_dataset(6), output=tmp_path / "run")
    assert ways == [("frame", "frame")] * 12


def test_a_second_try_that_is_not_finite_is_given_up(tried, tmp_path, monkeypatch):
    step = stepping.training_step

    def spoilt(state, frames):
        result = step(state, frames)
        return result._replace(failed="the loss") if state.config.pretrain.arap_by == "moment" else result

    monkeypatch.setattr(stepping, "training_step", spoilt)
    fit(CONFIG, tiny_dataset(6), output=tmp_path / "run")
    assert notes_of(tmp_path / "run") == ["the loss is not finite the second time; the first motion is kept"]


def test_exposure_and_points_of_the_kept_motion(tried, tmp_path, monkeypatch):
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


def test_a_live_view_shows_the_second_try(tried, tmp_path):
    shown: list[tuple[str, int, bool]] = []

    class Viewer:
        def due(self) -> bool:
            return True

        def show(self, state: TrainState) -> None:
            shown.append((state.stage, state.step, state.config.pretrain.progressive))

    fit(CONFIG, tiny_dataset(6), output=tmp_path / "run", watcher=Viewer())
    first, second = ([("pretrain", step, again) for step in range(1, 13)] for again in (False, True))
    assert shown == first + second + [("main", step, False) for step in range(13, 41)]


def test_an_image_that_is_lost_in_the_second_try(tried, tmp_path, monkeypatch):
    def lost(*_, **__):
        raise FrameError("train/r_003.png: no such file")

    monkeypatch.setattr(second_try, "take_step", lost)
    with pytest.raises(UserError, match=r"r_003.png: no such file; step 12 is saved: continue with --resume"):
        fit(CONFIG, tiny_dataset(6), output=tmp_path / "run")
