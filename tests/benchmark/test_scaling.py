"""Sweeps, tiny: every point is measured, limits are below times, figures are drawn, mistakes are one line."""

from __future__ import annotations

import json

import pytest
import torch
from PIL import Image

from scgs_warp.apps import bench as app
from scgs_warp.benchmark import plan, plot, roofline, scaling, scenes
from scgs_warp.errors import UserError
from scgs_warp.kernels.cpu import roofline as kernels
from scgs_warp.kernels.types import LANES, ROOFLINE_BLOCK, ROOFLINE_CHAINS
from scgs_warp.runtime import environment
from scgs_warp.runtime.launch import launch

pytestmark = pytest.mark.usefixtures("all_threads")

TINY = ["--gaussians", "150", "--nodes", "12", "--size", "48", "--seconds", "0", "--device", "cpu"]
SWEEPS = "gaussians:100/200,resolution:32/64,nodes:6/24,threads:1"


def test_all_sweeps(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(roofline, "BLOCKS", 4)
    path, figures = tmp_path / "scaling.json", tmp_path / "figures"
    files = ["--json", str(path), "--figures", str(figures)]
    assert app.cli(["scaling", *TINY, "--sweeps", SWEEPS, *files]) == 0
    said = capsys.readouterr()
    assert "1 of 7" in said.err and "left" in said.err and "nodes 24: frame" in said.out and "GB/s" in said.out
    report = json.loads(path.read_text(encoding="utf-8"))
    assert {name: [entry["point"] for entry in entries] for name, entries in report["sweeps"].items()} == {
        "gaussians": [100, 200],
        "resolution": [32, 64],
        "nodes": [6, 24],
        "threads": [1],
    }
    keys = {"gaussians": "gaussians", "resolution": "width", "nodes": "control_points", "threads": "threads"}
    usual = {"gaussians": 150, "resolution": 48, "nodes": 12, "threads": environment.available_threads()}
    for name, entries in report["sweeps"].items():
        for entry in entries:
            wholes = [row for row in entry["rows"] if row["share"] is None]
            assert [row["name"] for row in wholes] == ["frame", "raster/both"]
            for row in entry["rows"]:
                assert tuple(row) == plan.KEYS
                assert {key: row[column] for key, column in keys.items()} == {**usual, name: entry["point"]}
            for row in wholes:
                assert 0 < entry["limits"][row["name"]] < row["ms_median"]
    for name in report["sweeps"]:
        file = figures / f"scaling-{name}.png"
        assert file.stat().st_size < 80_000
        with Image.open(file) as image:
            # Older matplotlibs cut the last pixel off where a side in inches is no exact number.
            assert image.size == pytest.approx([side * plot.DPI for side in plot.SIZE], abs=1)
            assert len(image.convert("RGB").getcolors(1 << 20)) > 20


def test_lines_leave_out_what_a_point_lacks():
    rows = [{"name": "frame", "ms_median": 2.0}]
    entries = [
        {"point": 1, "rows": rows, "limits": {"frame": 0.5}},
        {"point": 2, "rows": [*rows, {"name": "frame/skin", "ms_median": 1.0}], "limits": {"frame": 0.6}},
    ]
    assert plot.series(entries, "frame") == ([1, 2], [2.0, 2.0], [0.5, 0.6])
    assert plot.series(entries, "frame/skin") == ([2], [1.0], [])
    assert plot.series([{**entries[0], "limits": None}], "frame") == ([1], [2.0], [])


def test_default_points_are_those_of_the_issue(monkeypatch):
    monkeypatch.setattr(environment, "available_threads", lambda: 12)
    found = scaling.parse_sweeps("gaussians,resolution,nodes,threads")
    ends = {name: (points[0], points[-1]) for name, points in found.items()}
    assert ends == {
        "gaussians": (10_000, 2_000_000),
        "resolution": (200, 1600),
        "nodes": (64, 4096),
        "threads": (1, 12),
    }
    assert found["threads"] == (1, 2, 4, 8, 12)
    assert scaling.parse_sweeps("nodes: 70/8 ") == {"nodes": (8, 70)}


@pytest.mark.parametrize(
    ("sweeps", "said"),
    [
        ("gaussian", "'gaussian'"),
        ("nodes:3", "nodes:3"),
        ("nodes:1000", "nodes:1000"),
        ("gaussians:5", "gaussians:5"),
        ("resolution:8", "resolution:8"),
        ("resolution:", "must be numbers"),
        ("nodes:8/x", "must be numbers"),
        ("threads:0", "threads:0"),
        ("", "''"),
    ],
)
def test_mistakes_are_one_line_and_status_2(sweeps, said, capsys):
    assert app.cli(["scaling", *TINY, "--sweeps", sweeps]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_figures_that_cannot_be_written(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    row = {
        "name": "frame",
        "ms_median": 1.0,
        "gaussians": 1,
        "control_points": 1,
        "width": 1,
        "height": 1,
        "threads": 1,
    }
    entries = [{"point": 1, "rows": [row], "limits": None}]
    report = {"machine": {"gpu": None, "processor": "x"}, "sweeps": {"nodes": entries}}
    with pytest.raises(UserError, match="--figures"):
        plot.draw(report, file)


@pytest.mark.parametrize("threads", [1, 2])
def test_the_loops_do_what_their_time_is_taken_for(threads):
    environment.configure(threads)
    rounds, values = 7, torch.zeros(5)
    launch(kernels.multiply_add, 5, rounds, values, grain=1)
    total = 0.0
    for k in range(ROOFLINE_CHAINS):
        x = 0.1 * (k + 1)
        for _ in range(rounds):
            x = x * 0.999 + 0.001
        total += LANES * x
    assert values.tolist() == pytest.approx([total] * 5, rel=1e-5)
    source, target = torch.rand(3 * ROOFLINE_BLOCK), torch.zeros(4 * ROOFLINE_BLOCK)
    launch(kernels.copy, 3, source, target, grain=1)
    assert torch.equal(target[: 3 * ROOFLINE_BLOCK], source) and not bool(target[3 * ROOFLINE_BLOCK :].any())


def test_limits_are_those_of_a_computer():
    environment.configure(1)
    found = roofline.measure_limits(2, blocks=8)
    assert found.threads == 2 and environment.thread_count() == 1
    assert 0.5 < found.gigabytes < 2000 and 2 < found.gigaflops < 50_000
    both = roofline.Limits(1, gigabytes=10.0, gigaflops=100.0)
    assert both.milliseconds(roofline.Work(1e7, 1e6)) == pytest.approx(1.0)
    assert both.milliseconds(roofline.Work(1e3, 3e8)) == pytest.approx(3.0)


def test_work_counts_what_the_models_say():
    load = scenes.Load(pairs=1000, contributors=10.0, covered=50)
    scene = scenes.synthetic_scene("control-points", 200, 20, "cpu")
    work = roofline.frame_work(scene, load, 40, 30)
    layers = [layer for layer in scene.motion.network.modules() if isinstance(layer, torch.nn.Linear)]
    weights = sum(layer.in_features * layer.out_features for layer in layers)
    assert work["network"].flops == 2 * 20 * weights
    assert work["composite"] == roofline.Work(1000 * 44 + 4 * 40 * 30 * 5, 500 * 36.0)
    assert work["skin"] == roofline.Work(200 * (56 + 32 + 4 * 37 + 24), 200 * (128.0 + 56 + 2 * 37))
    assert work["project"].bytes == 200 * 80 and work["harmonics"].bytes == 200 * 216
    assert set(roofline.frame_work(scenes.synthetic_scene("static", 60, 12, "cpu"), load, 40, 30)) == {
        *("project", "harmonics", "bin", "composite")
    }
    dense = roofline.frame_work(scenes.synthetic_scene("per-gaussian", 60, 12, "cpu"), load, 40, 30)
    assert dense["network"].flops > 2 * 60 * 400_000 and "skin" not in dense
    double = roofline.backward_work(400, scenes.Load(2000, 10.0, 100), 40, 60)
    single = roofline.backward_work(200, load, 40, 30)
    assert double.bytes == 2 * single.bytes and double.flops == 2 * single.flops > 0
