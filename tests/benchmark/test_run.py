"""Benchmarks, tiny: rows are complete and mean what they say, the timed code is the real one, mistakes are one line."""

from __future__ import annotations

import pytest

from helpers.bench_rows import TINY, check_rows, rows_of
from scgs_warp.apps import bench as app
from scgs_warp.benchmark import run as bench
from scgs_warp.benchmark import scenes
from scgs_warp.config.presets import MOTIONS
from scgs_warp.errors import UserError
from scgs_warp.storage.checkpoint import write as write_checkpoint

pytestmark = pytest.mark.usefixtures("all_threads")


def test_frames_of_every_motion_model(tmp_path, device, capsys):
    rows = rows_of(tmp_path, "frame", *TINY, "--motion", ",".join(MOTIONS), "--device", device)
    check_rows(rows, device)
    drawn = ["project", "harmonics", "bin", "composite", "rest"]
    stages = {
        motion: [row["name"].removeprefix("frame/") for row in rows if row["motion"] == motion][1:]
        for motion in MOTIONS
    }
    assert stages == {
        "control-points": ["network", "skin", *drawn],
        "per-gaussian": ["network", *drawn],
        "hexplane": ["network", *drawn],
        "static": drawn,
    }
    assert {row["motion"]: row["control_points"] for row in rows} == dict.fromkeys(MOTIONS, 0) | {"control-points": 12}
    printed = capsys.readouterr().out
    assert "frame/composite" in printed and "120 Gaussians" in printed


@pytest.mark.parametrize("what", ["frame", "raster", "step"])
def test_width_and_height(tmp_path, what):
    arguments = ["--gaussians", "120", "--nodes", "12", "--size", "70x41", "--seconds", "0", "--threads", "1"]
    rows = rows_of(tmp_path, what, *arguments, "--device", "cpu")
    assert {(row["width"], row["height"]) for row in rows} == {(70, 41)}


def test_rasterisation_forward_and_both(tmp_path, device):
    rows = rows_of(tmp_path, "raster", *TINY, "--device", device)
    check_rows(rows, device)
    names = [row["name"] for row in rows]
    assert names[0] == "raster/forward" and "raster/both" in names and "raster/both/backward" in names
    shares = {row["name"]: row["share"] for row in rows}
    assert shares["raster/both"] is None and 0 < shares["raster/both/backward"] < 1


def test_steps_with_and_without_arap(tmp_path, device):
    rows = rows_of(tmp_path, "step", *TINY, "--motion", "control-points,static", "--device", device)
    check_rows(rows, device)
    names = [row["name"] for row in rows if row["motion"] == "control-points"]
    assert {"step/loss", "step/backward", "step/adam", "step/network", "step/skin"} < set(names)
    median = {row["name"]: row["ms_median"] for row in rows if row["motion"] == "control-points"}
    assert median["step/arap/arap"] > 0.0 and "step/arap" in names and "step/arap/adam" in names
    assert "step/arap" not in [row["name"] for row in rows if row["motion"] == "static"]


def test_one_and_all_threads_by_default(monkeypatch):
    monkeypatch.setattr(bench.environment, "available_threads", lambda: 6)
    assert bench.thread_counts(None, "cpu") == (1, 6)
    assert bench.thread_counts(3, "cpu") == (3,)
    assert len(bench.thread_counts(None, "cuda")) == 1


def test_a_run_s_scene(tmp_path):
    scene = scenes.synthetic_scene("control-points", 150, 12, "cpu")
    run = tmp_path / "run"
    run.mkdir()
    write_checkpoint(run, scene.tensors(), {**scene.metadata(), "stage": "main"})
    for what in ("frame", "raster", "step"):
        rows = rows_of(tmp_path, what, "--run", str(run), "--size", "48", "--seconds", "0", "--threads", "1")
        assert {(row["gaussians"], row["control_points"], row["motion"]) for row in rows} == {
            (150, 12, "control-points")
        }


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["frame", "--motion", "walk"], "'walk'"),
        (["frame", "--nodes", "3"], "--nodes 3"),
        (["frame", "--gaussians", "100"], "--gaussians 100"),
        (["step", "--size", "4"], "--size 4"),
        (["frame", "--size", "1920x"], "--size 1920x"),
        (["frame", "--size", "800x9000"], "--size 800x9000"),
        (["frame", "--size", "1x2x3"], "--size 1x2x3"),
        (["raster", "--size", "big"], "--size big"),
        (["frame", "--run", "nowhere"], "nowhere"),
        (["frame", "--run", "nowhere", "--gaussians", "1000"], "--gaussians"),
        (["frame", "--run", "nowhere", "--table-s2"], "--table-s2"),
        (["frame", "--against", "gsplat"], "raster"),
        (["raster", "--against", "gsplat", "--device", "cpu"], "CUDA"),
        (["raster", "--threads", "0"], "--threads 0"),
        (["raster", "--seconds", "-1"], "--seconds -1"),
    ],
)
def test_mistakes_are_one_line_and_status_2(arguments, said, capsys):
    assert app.cli(arguments) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_a_file_that_cannot_be_written(tmp_path):
    with pytest.raises(UserError, match=f"{tmp_path.name}: cannot be written"):
        bench.write({}, tmp_path)
