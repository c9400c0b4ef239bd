"""Metrics of a split: means over images, what they were measured on, and the files beside them."""

from __future__ import annotations

import dataclasses
import errno
import json
import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.fake_scene import FakeScene, fake_dataset, install
from reference.ssim import ssim_map
from scgs_warp import data
from scgs_warp.apps import evaluate as app
from scgs_warp.data import Dataset
from scgs_warp.errors import UserError
from scgs_warp.evaluation.evaluate import MOST_DECIBELS, evaluate, metrics_of, write_metrics
from scgs_warp.visualization import figures

CONTRACT = {"psnr", "ssim", "lpips", "split", "images", "step", "seconds", "gaussians", "control_points", "motion",
            "device", "data", "downscale", "resample", "background", "seed"}  # fmt: skip


def test_means_over_images() -> None:
    scene = FakeScene()
    first, second = fake_dataset(scene, 3, error=0.1), fake_dataset(scene, 2, error=0.01)
    both = Dataset([*first, *second], folder=Path("x"), split="test")
    seen = []
    found = evaluate(scene, both, progress=lambda done, total: seen.append((done, total)))
    assert found["images"] == 5 and seen == [(index + 1, 5) for index in range(5)]
    assert found["psnr"] == pytest.approx((3 * 20 + 2 * 40) / 5, abs=1e-3)  # not the PSNR of the mean error
    assert found["lpips"] is None and "lpips" not in found["per_image"][0]
    expected = []
    for frame in both:
        image = scene.render(frame.camera, frame.time).rgb.permute(2, 0, 1).double()
        expected.append(float(ssim_map(image, frame.image.permute(2, 0, 1).double()).mean()))
    np.testing.assert_allclose([row["ssim"] for row in found["per_image"]], expected, atol=1e-5)
    assert found["ssim"] == pytest.approx(math.fsum(expected) / 5, abs=1e-5)
    assert [row["name"] for row in found["per_image"]] == ["r_000", "r_001", "r_002", "r_000_00003", "r_001_00004"]
    assert [row["time"] for row in found["per_image"]] == [0, 0.5, 1, 0, 1]


def test_lpips_gets_clamped_images() -> None:
    scene = FakeScene()

    def lpips(image: torch.Tensor, truth: torch.Tensor) -> float:
        assert image.shape == truth.shape == (40, 40, 3) and truth.max() <= 1 and truth.min() >= 0
        return float((truth - image).mean())

    found = evaluate(scene, fake_dataset(scene, 2, error=0.1), lpips=lpips)
    assert found["lpips"] == pytest.approx(0.1, abs=1e-5)


def test_masked_pixels_do_not_count() -> None:
    scene = FakeScene()
    frame = fake_dataset(scene, 1, error=0.1)[0]
    mask = torch.zeros(40, 40, dtype=torch.bool)
    mask[:, :20] = True
    spoilt = frame.image.clone()
    spoilt[:, 20:] = 1.0
    masked = type(frame)(frame.camera, frame.time, spoilt, frame.alpha, mask, "a")
    found = evaluate(scene, Dataset([masked], folder=Path("x"), split="test"))
    assert found["psnr"] == pytest.approx(20.0, abs=1e-3)
    image, truth = (
        x.permute(2, 0, 1).double() for x in (scene.render(frame.camera, frame.time).rgb, spoilt.clamp(0, 1))
    )
    expected = ssim_map(torch.where(mask, image, truth), truth)[:, mask].mean()
    assert found["ssim"] == pytest.approx(float(expected), abs=1e-5)
    assert abs(found["ssim"] - float(ssim_map(image, truth).mean())) > 1e-2


def test_lpips_sees_no_difference_where_nothing_is_known() -> None:
    """It has no mask of its own: the truth is shown in both images there."""
    scene, seen = FakeScene(), []
    frame = fake_dataset(scene, 1, error=0.1)[0]
    mask = torch.zeros(40, 40, dtype=torch.bool)
    mask[:, :20] = True
    masked = type(frame)(frame.camera, frame.time, frame.image, frame.alpha, mask, "a")
    evaluate(
        scene,
        Dataset([masked], folder=Path("x"), split="test"),
        lpips=lambda image, truth: seen.append((truth - image).abs()) or 0.0,
    )
    assert torch.equal(seen[0][:, 20:], torch.zeros(40, 20, 3))
    torch.testing.assert_close(seen[0][:, :20], torch.full((40, 20, 3), 0.1), rtol=0.0, atol=1e-5)


def test_the_worst_image_is_named_by_its_time() -> None:
    scene = FakeScene()
    good, bad = fake_dataset(scene, 3, error=0.01), fake_dataset(scene, 3, error=0.1)
    found = evaluate(scene, Dataset([good[0], bad[1], good[2]], folder=Path("x"), split="test"))
    assert found["psnr_worst"] == pytest.approx(20.0, abs=1e-3) and found["psnr_worst_time"] == bad[1].time == 0.5
    assert found["psnr_median"] == pytest.approx(40.0, abs=1e-2)


def test_the_sheet_shows_no_error_where_nothing_is_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, seen = FakeScene(), []
    frame = fake_dataset(scene, 1, error=0.1)[0]
    mask = torch.zeros(40, 40, dtype=torch.bool)
    mask[:, :20] = True
    spoilt = frame.image.clone()
    spoilt[:, 20:] = 0.7
    masked = type(frame)(frame.camera, frame.time, spoilt, frame.alpha, mask, "a")
    monkeypatch.setattr(
        "scgs_warp.evaluation.evaluate.contact_sheet",
        lambda rows, titles, **more: seen.append((rows, more["scores"])) or figures.contact_sheet(rows, titles, **more),
    )
    found = evaluate(scene, Dataset([masked], folder=Path("x"), split="test"), render_dir=tmp_path)
    (((truth, shown),), scores) = seen[0]
    assert (truth[:, 20:] == shown[:, 20:]).all() and (truth[:, :20] != shown[:, :20]).any()
    assert scores == [found["psnr"]] == [pytest.approx(20.0, abs=0.01)]


def test_renders_lie_beside_the_truth(tmp_path: Path) -> None:
    scene = FakeScene()
    first = fake_dataset(scene, 3, error=0.1)
    twice = Dataset([*first, *first], folder=Path("x"), split="test")  # equal names must not overwrite each other
    evaluate(scene, twice, render_dir=tmp_path / "made")
    names = sorted(path.name for path in (tmp_path / "made" / "renders").iterdir())
    assert len(names) == 6 and names == sorted(path.name for path in (tmp_path / "made" / "truth").iterdir())
    found = cv2.imread(str(tmp_path / "made" / "renders" / "r_001.png"))[..., ::-1]
    np.testing.assert_array_equal(found, figures.to_bytes(scene.render(first[1].camera, first[1].time).rgb))
    truth = cv2.imread(str(tmp_path / "made" / "truth" / "r_001.png"))[..., ::-1]
    np.testing.assert_array_equal(truth, figures.to_bytes(first[1].image))
    assert cv2.imread(str(tmp_path / "made" / "contact_sheet.png")).shape[1] == 4 * 30 + 4  # cropped


def test_each_frame_has_a_file_of_its_own(tmp_path: Path) -> None:
    """Also where the number that tells two frames apart is another frame's name."""
    scene = FakeScene()
    frames = [*fake_dataset(scene, 3, error=0.1)] * 3
    names = ["00001", "00001", "00001_00001", "", "00003", "", "", "00001", "00001_00007"]
    named = [dataclasses.replace(frame, name=name) for frame, name in zip(frames, names)]
    found = evaluate(scene, Dataset(named, folder=Path("x"), split="test"), render_dir=tmp_path / "made")
    listed = [row["name"] for row in found["per_image"]]
    assert listed[0] == "00001" and len(set(listed)) == 9
    for kind in ("renders", "truth"):
        assert sorted(path.stem for path in (tmp_path / "made" / kind).iterdir()) == sorted(listed)


def test_pictures_of_an_earlier_evaluation_do_not_stay_among_the_new_ones(tmp_path: Path) -> None:
    scene = FakeScene()
    for count in (3, 2):
        evaluate(scene, fake_dataset(scene, count), render_dir=tmp_path)
        (tmp_path / "renders" / "notes.txt").touch()
    assert sorted(path.name for path in (tmp_path / "truth").iterdir()) == ["r_000.png", "r_001.png"]
    assert sorted(path.name for path in (tmp_path / "renders").iterdir()) == ["notes.txt", "r_000.png", "r_001.png"]


def test_an_image_that_equals_the_truth_counts_as_a_hundred_decibels() -> None:
    """A view beside the subject shows the background alone; infinity would be the mean of all images."""
    scene = FakeScene()
    frames = [*fake_dataset(scene, 2, error=0.1), fake_dataset(scene, 1, error=0.0)[0]]
    found = evaluate(scene, Dataset(frames, folder=Path("x"), split="test"))
    assert found["psnr"] == pytest.approx((20 + 20 + MOST_DECIBELS) / 3, abs=1e-3)
    assert found["psnr_median"] == found["psnr_worst"] == pytest.approx(20, abs=1e-3)


def test_nowhere_to_write_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    scene = FakeScene()
    with pytest.raises(UserError, match="cannot be written"):
        evaluate(scene, fake_dataset(scene, 1), render_dir=tmp_path / "file" / "renders")
    with pytest.raises(UserError, match="cannot be written"):
        write_metrics({}, tmp_path / "file" / "metrics.json")


@pytest.mark.parametrize(
    ("number", "remedy"),
    [(errno.ENOSPC, "free space there"), (errno.EROFS, "copy the run to a folder that can be written")],
)
def test_what_helps_depends_on_why_nothing_can_be_written(tmp_path, monkeypatch, number, remedy) -> None:
    def refuse(path: Path, image: object) -> None:
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr("scgs_warp.evaluation.evaluate.write_png", refuse)
    scene = FakeScene()
    with pytest.raises(UserError, match=rf"r_000\.png: cannot be written .*; {remedy}$"):
        evaluate(scene, fake_dataset(scene, 1), render_dir=tmp_path)


def test_metrics_keep_the_contract(tmp_path: Path) -> None:
    scene = FakeScene()
    found = metrics_of(scene, fake_dataset(scene, 2), seconds=12.5)
    assert found.keys() >= CONTRACT
    assert (found["step"], found["seconds"], found["seed"], found["downscale"]) == (1234, 12.5, 7, 2)
    assert (found["motion"], found["control_points"], found["gaussians"]) == ("control-points", 32, 2)
    write_metrics(found, tmp_path / "metrics.json")
    read = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=pytest.fail)  # JSON has no Infinity
    assert read["psnr"] is None or read["psnr"] > 60  # equal images
    assert read["ssim"] == pytest.approx(1.0)
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.json"]


def test_true_motion_is_scored_where_the_data_has_it(tmp_path: Path) -> None:
    """A surface point on each ball; the truth circles once as fast as the scene, once exactly with it."""
    scene = FakeScene()
    for speed, expected in ((1.0, 0.0), (0.5, None)):
        times = np.linspace(0, 1, 5)
        moving = np.stack([scene.centre(speed * time) for time in times]) + np.array([0, 0, 0.3])
        points = np.stack([moving, np.tile([0.0, 0.0, 0.3], (5, 1))], axis=1)
        np.savez(tmp_path / "ground_truth.npz", points=points, times=times, visible=np.ones((2, 2), bool), height=2.0)
        frames = Dataset(fake_dataset(scene, 1), folder=tmp_path, split="test")
        found = metrics_of(scene, frames)
        if expected == 0.0:
            assert found["epe"] == pytest.approx(0.0, abs=1e-4) and found["jitter"] == pytest.approx(0.0, abs=1e-4)
        else:
            gaps = [np.linalg.norm(scene.centre(time) - scene.centre(speed * time)) for time in times]
            assert found["epe"] == pytest.approx(50 * np.mean(gaps) / 2, rel=1e-4)  # one of two points, percent of 2


def test_an_empty_split_has_no_metrics() -> None:
    found = evaluate(FakeScene(), Dataset([], folder=Path("x"), split="val"))
    assert (found["psnr"], found["ssim"], found["images"]) == (None, None, 0)


def test_the_app_writes_table_json_and_renders(monkeypatch, tmp_path, capsys) -> None:
    scene = FakeScene(folder=str(tmp_path))
    install(monkeypatch, scene)
    asked = {}

    def load(folder: str, split: str, **options: object) -> Dataset:
        asked.update(options, folder=str(folder), split=split)
        return fake_dataset(scene, 3, error=0.1)

    monkeypatch.setattr(data, "load", load)
    (tmp_path / "metrics.json").write_text('{"seconds": 99.0}')
    assert app.cli(["--run", str(tmp_path)]) == 0
    assert asked == {
        "folder": str(tmp_path),
        "split": "test",
        "downscale": 2,
        "resample": "area",
        "background": "black",
    }
    folder = tmp_path / "evaluation" / "test"
    found = json.loads((folder / "metrics.json").read_text())
    assert found["psnr"] == pytest.approx(20.0, abs=1e-3) and found["seconds"] == 99.0 and len(found["per_image"]) == 3
    assert len(list((folder / "renders").iterdir())) == 3
    assert "20.00" in capsys.readouterr().out
    assert app.cli(["--run", str(tmp_path), "--json", str(tmp_path / "other.json"), "--data", "elsewhere"]) == 0
    assert (tmp_path / "other.json").is_file() and asked["folder"] == "elsewhere"


@pytest.mark.parametrize("folder, words", [("/nowhere/at/all", "--data"), ("", "data.folder")])
def test_data_that_moved_away(monkeypatch, tmp_path, capsys, folder: str, words: str) -> None:
    install(monkeypatch, FakeScene(folder=folder))
    assert app.cli(["--run", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert app.cli(["--run", str(tmp_path / "missing")]) == 2
