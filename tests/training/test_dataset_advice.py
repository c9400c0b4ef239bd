"""Advice: what the survey of a data set finds, and that each remark is made of data that deserve it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch
import tyro

from helpers.handheld import handheld
from helpers.layouts import write_colmap, write_poses_bounds
from helpers.tiny import tiny_dataset, write_dnerf
from scgs_warp.config.presets import MOTIONS, PRESETS, preset, with_steps
from scgs_warp.data import Dataset, load
from scgs_warp.training.automatic import resolve_auto
from scgs_warp.training.dataset_advice import Survey, advise, looks_away, survey


def lines(data: Dataset, **changes) -> tuple[str, str]:
    found = advise(survey(data), dataclasses.replace(preset("cpu"), **changes))
    assert not any("\n" in line for line in found)
    return found


def test_a_survey_counts_frames_times_and_turns():
    found = survey(handheld(41, 2.0))
    assert (found.frames, found.width, found.height, found.instants, found.views) == (41, 32, 24, 41, 1)
    assert found.arc == pytest.approx(80, abs=2) and found.turn == pytest.approx(2, abs=0.1)
    assert found.flicker == 0 and not found.cut_out and found.points == 0
    assert found.typical_gap == pytest.approx(1 / 40)


def test_the_lines_describe_one_camera_that_moves_slowly():
    first, second = lines(handheld(41, 2.0))
    assert first == (
        "data: 41 frames of 32 x 24 at 41 times; one camera, 2.0 degrees from frame to frame, 79 in all; "
        "filled images; no points"
    )
    assert "motion along the line of sight" in second and "COLMAP's points" in second


def test_hardly_any_parallax_is_told():
    assert "leaves depth unknown" in lines(handheld(30, 0.1))[1]


def test_depth_of_movers_that_cannot_be_known():
    """A camera that moves by 0.5 degrees from frame to frame moves by 2 while four of 40 intervals pass."""
    assert survey(handheld(41, 0.5)).sweep == pytest.approx(2.0, abs=0.1)
    assert "it moves by 2.0 degrees within a tenth of the time" in lines(handheld(41, 0.5))[1]
    assert "is a guess" not in lines(handheld(41, 2.0))[1]
    mixed = list(handheld(41, 0.5))[::-1]
    assert survey(Dataset(mixed, folder=Path("mixed"), split="train")).sweep == pytest.approx(2.0, abs=0.1)
    assert survey(handheld(1)).sweep == 180.0


def test_depth_maps_tell_what_one_camera_cannot():
    for arc in (0.5, 0.01):
        data = handheld(41, arc)
        mapped = [dataclasses.replace(frame, depth=torch.ones(24, 32)) for frame in data[1:]]
        first, second = lines(Dataset([data[0], *mapped], folder=Path("mapped"), split="train"))
        assert "40 depth maps" in first and "as good as the depth maps" in second
        assert "depth maps" not in lines(data)[0]
        off = dataclasses.replace(preset("cpu").loss, depth=0.0)
        few = Dataset([*data[:30], *mapped[29:]], folder=Path("few"), split="train")
        for unlike, changes in ((few, {}), (Dataset(mapped, folder=Path("off"), split="train"), {"loss": off})):
            assert "as good as the depth maps" not in lines(unlike, **changes)[1]


def rig(own_moments: float = 0.0, flicker: float = 0.0, moments: int = 8, then: float = 0.0) -> Dataset:
    """Three cameras that stand 4 degrees apart, each darker than the one before.

    Args:
        own_moments: delay of a camera after the one before, as a share of the time between frames.
        then: delay of a camera after the one before, as a share of the film.
    """
    frames = []
    for number in range(3):
        first = handheld(3, 4.0)[number]
        for moment in range(moments):
            light = (1.0 - 0.2 * number) * (1.0 - flicker * (moment % 2))
            time = (moment + own_moments * number) / moments + then * number
            frames.append(dataclasses.replace(first, time=time, image=first.image * light))
    return Dataset(frames, folder=Path("rig"), split="train")


@pytest.mark.parametrize("own_moments", [0.0, 0.05, 0.1, 0.2, 0.5])
def test_cameras_that_stand_still_are_told_from_one_that_moves(own_moments):
    """Cameras that are not locked have few instants in common; they differ in brightness, but none of them flickers."""
    data = rig(own_moments)
    found = survey(data)
    assert found.standing == 3 and found.flicker == 0 and found.typical_gap == pytest.approx(1 / 8)
    first, second = lines(data)
    assert ("3 cameras that stand still" if own_moments else "3 views of each instant") in first
    assert "one camera" not in first and "degrees from frame to frame" not in first
    assert second.startswith("expect good views between the cameras at all times")
    assert survey(rig(own_moments, flicker=0.2)).flicker == pytest.approx(0.25, abs=0.01)
    config = preset("cpu")
    assert advise(dataclasses.replace(found, points=5000), config)[1].endswith("; the settings fit")
    film = dataclasses.replace(survey(handheld(41, 2.0)), points=5000)
    assert "optim.cameras" in advise(film, config)[1]


def test_images_that_show_nothing():
    data = handheld(8, 2.0)
    black = [dataclasses.replace(frame, image=torch.zeros_like(frame.image)) for frame in data]
    assert "expect nothing: the images show nothing" in lines(Dataset(black, folder=Path("x"), split="train"))[1]
    assert not survey(data).blank


def test_a_batch_sees_frames_more_often():
    facts = dataclasses.replace(survey(handheld(41, 2.0)), points=5000)
    config = with_steps(preset("cpu"), 200)
    assert "each frame is seen 5 times only: --steps 1000" in advise(facts, config)[1]
    assert "each frame is seen" not in advise(facts, dataclasses.replace(config, batch=8))[1]
    assert "--steps 10000" in advise(dataclasses.replace(facts, frames=1000), dataclasses.replace(config, batch=2))[1]


def test_a_camera_that_moves_or_was_moved_is_no_rig():
    assert survey(handheld(41, 2.0)).standing == 0 and survey(rig(0.2, moments=3)).standing == 0
    moved = rig(then=1.5)
    assert survey(moved).standing == 0, "one camera that was moved twice"
    assert "that stand still" not in lines(moved)[0]


def test_changing_brightness_is_told_and_black_images_are_none():
    assert "brightness changes by 20 %" in lines(handheld(exposure=0.2))[1]
    assert "brightness" not in lines(handheld(exposure=0.04))[1]
    dark = [dataclasses.replace(f, alpha=torch.zeros(24, 32), image=f.image * 0) for f in handheld(10, alpha=True)]
    assert survey(Dataset(dark, folder=Path("dark"), split="train")).flicker == 0


@pytest.mark.parametrize("background", ["black", "white"])
def test_a_figure_that_comes_closer_is_no_exposure(background):
    frames = []
    for index, frame in enumerate(handheld(20, alpha=True)):
        alpha = torch.zeros(24, 32)
        alpha[: 6 + 8 * (index % 2)] = 1.0
        image = 0.4 * alpha[..., None].expand(24, 32, 3) + (background == "white") * (1 - alpha[..., None])
        frames.append(dataclasses.replace(frame, alpha=alpha, image=image))
    data = Dataset(frames, folder=Path("figure"), split="train", background=background)
    assert survey(data).flicker < 1e-6


@pytest.mark.parametrize(
    ("scale", "said"), [((0.0, 0.1), "only go from 0 to 0.1:"), ((1.0 - 1e-8, 1.0), "from 1 to 1:"), ((0.02, 0.97), "")]
)
def test_times_that_cover_a_part(scale, said):
    first, last = scale
    frames = [dataclasses.replace(frame, time=first + (last - first) * frame.time) for frame in handheld(41, 2.0)]
    line = lines(Dataset(frames, folder=Path("part"), split="train"))[1]
    assert (f"{said} scale them to go from 0 to 1" in line) == bool(said) == ("guessed motion before" in line)


def test_a_gap_in_time():
    data = handheld(40)
    frames = [f for f in data if not 0.4 < f.time < 0.7]
    assert "guessed motion from time 0.38 to 0.72" in lines(Dataset(frames, folder=Path("gap"), split="train"))[1]


def test_frames_of_one_instant():
    still = [dataclasses.replace(frame, time=0.5) for frame in handheld(12, 5.0)]
    first, second = lines(Dataset(still, folder=Path("still"), split="train"))
    assert "12 views of each instant" in first and "--motion static" in second


def test_a_camera_that_is_elsewhere_at_each_instant():
    first, second = lines(tiny_dataset(16))
    assert "cut out by alpha" in first and "where the motion from one instant to the next is small" in second


def test_too_few_steps_and_large_images_are_told():
    assert "--steps 1000 sees" in lines(handheld(40), steps=400)[1]
    found = survey(handheld(40))
    large = dataclasses.replace(found, width=4000, height=3000)
    assert "--downscale 4" in advise(large, preset("cpu"))[1]
    assert "--downscale" not in advise(large, preset("cpu"), "cuda")[1]


def test_poses_of_colmap_may_be_refined(tmp_path):
    write_colmap(tmp_path)
    first, second = lines(load(tmp_path))
    assert "24 points" in first and "--set optim.cameras=2e-4" in second


def test_several_views_of_an_instant_are_told(tmp_path):
    write_poses_bounds(tmp_path)
    first, second = lines(load(tmp_path))
    assert "3 views of each instant" in first and "each instant is seen from several sides" in second


def test_a_single_frame_is_surveyed():
    assert survey(handheld(1)).instants == 1 and isinstance(survey(handheld(1)), Survey)
    assert len(lines(handheld(1))) == 2


def test_the_app_says_it(tmp_path, capsys):
    from scgs_warp.apps.train import cli

    write_colmap(tmp_path / "scene")
    arguments = ["--data", str(tmp_path / "scene"), "--output", str(tmp_path / "run"), "--steps", "12", "--nodes", "16"]
    assert cli([*arguments, "--device", "cpu", "--set", "init_points=200"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("data: 12 frames of 80 x 60") and said[1].startswith("expect ")


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("points", [0, 9, 500])
@pytest.mark.parametrize("steps", [None, 0])
def test_progressive_acts_or_a_line_says_that_it_does_not(name, motion, points, steps):
    """With every preset and motion model, with few and enough points, with stage 1 and without. Nobody asked for what
    the preset turns on itself."""
    data = handheld(6, 2.0)
    if points:
        data.points = torch.rand(points, 3)
    config = preset(name)
    pretrain = dataclasses.replace(config.pretrain, progressive=True)
    pretrain = pretrain if steps is None else dataclasses.replace(pretrain, steps=steps)
    model = dataclasses.replace(config.motion, model=motion)
    config = dataclasses.replace(config, pretrain=pretrain, motion=model)
    acts = resolve_auto(config, data).pretrain_steps > 0
    said = "--progressive has no effect" in advise(survey(data), config)[1]
    assert said is (not acts and not preset(name).pretrain.progressive)
    assert acts == (motion == "control-points" and steps is None and (points < 10 or name == "paper"))


def test_progressive_on_a_single_frame():
    pretrain = dataclasses.replace(preset("cpu").pretrain, progressive=True)
    assert "only one frame" in lines(handheld(1), pretrain=pretrain)[1]


def test_progressive_is_never_ignored_in_silence():
    """Where there is no stage 1, the line says so, and the reason is the one by which training leaves it out."""
    asked = dataclasses.replace(preset("cpu").pretrain, progressive=True)
    kept = dataclasses.replace(asked, with_points=True)
    data = handheld(41, 2.0)
    with_points = Dataset([data[i] for i in range(len(data))], folder=Path("points"), split="train")
    with_points.points = torch.rand(500, 3)
    config = preset("cpu")
    for given, pretrain, motion, silent in (
        (data, asked, "control-points", True),
        (with_points, asked, "control-points", False),
        (with_points, kept, "control-points", True),
        (data, asked, "hexplane", False),
        (with_points, config.pretrain, "control-points", True),
    ):
        model = dataclasses.replace(config.motion, model=motion)
        own = dataclasses.replace(config, pretrain=pretrain, motion=model)
        said = advise(survey(given), own)[1]
        assert ("--progressive has no effect" in said) is not silent
        if pretrain.progressive:
            assert (resolve_auto(own, given).pretrain_steps > 0) is silent


def test_a_resumed_run_is_progressive_as_it_began(tmp_path, capsys):
    """The option need not be repeated, and a run that began without it refuses it."""
    from scgs_warp.apps.train import cli

    data = write_dnerf(tmp_path / "scene", 32)
    small = ["--steps", "20", "--nodes", "16", "--device", "cpu", "--set", "init_points=200"]

    def run(name: str, *more: str) -> int:
        return cli(["--data", str(data), "--output", str(tmp_path / name), *small, *more])

    assert run("with", "--progressive") == run("without") == 0
    recorded = json.loads((tmp_path / "with/config.json").read_text())
    assert recorded["pretrain"]["progressive"] is True
    assert run("with", "--resume") == 0
    assert json.loads((tmp_path / "with/config.json").read_text()) == recorded
    capsys.readouterr()
    assert run("without", "--resume", "--progressive") == 2
    assert "pretrain.progressive = False, now True" in capsys.readouterr().err


def test_progressive_cannot_be_denied_in_vain():
    """--no-progressive would not turn it off where the preset turns it on."""
    from scgs_warp.apps.settings import Settings, configuration

    with pytest.raises(SystemExit) as caught:
        tyro.cli(Settings, args=["--no-progressive"])
    assert caught.value.code == 2
    options = tyro.cli(Settings, args=["--preset", "quick", "--set", "pretrain.progressive=false"])
    assert not configuration(options, None, {})[0].pretrain.progressive
    assert configuration(tyro.cli(Settings, args=["--progressive"]), None, {})[0].pretrain.progressive


def test_few_steps_for_a_moving_subject():
    data = tiny_dataset()
    assert "1,500 steps are few: thin or fast parts" in lines(data, steps=1_500)[1]
    assert "are few" not in lines(data, steps=7_000)[1] and "are few" not in lines(handheld(30, 2.0), steps=1_500)[1]
    still = dataclasses.replace(preset("cpu").motion, model="static")
    assert "are few" not in lines(data, steps=1_500, motion=still)[1]


@pytest.mark.parametrize("points", [True, False])
def test_cameras_that_look_away(points):
    """As when OpenCV's poses are given as OpenGL's."""
    data = tiny_dataset(12)
    if points:
        data.points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)) * 0.3
    assert not looks_away(data) and "look away" not in lines(data)[1]
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    turned = data.with_cameras([dataclasses.replace(c, viewmat=flip @ c.viewmat) for c in data.cameras])
    assert looks_away(turned)
    assert "the cameras look away from the content; poses in transforms.json are OpenGL's" in lines(turned)[1]
