"""The script for machines with a GPU works, tried small on the CPU; and its checks can fail."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
import torch.distributed as dist

from helpers.paths import ROOT
from scgs_warp.scene.frame_graph import FrameGraph

FOLDER = ROOT / "benchmarks"
SCRIPT = FOLDER / "gpu_check.py"
BODIES = {"good": "pass", "bad": "assert False", "endless": "time.sleep(60)"}
"""Three tests, of which the last is stopped."""


def run(*options: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, SCRIPT, "--device", "cpu", "--quick", *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def test_quick_run_on_the_cpu(tmp_path: Path):
    output = tmp_path / "report.json"
    parts = "agreement,frames,forms,raster,dynamic,step,gsplat,fuzz,crowded"
    result = run("--parts", parts, "--output", output)
    assert result.returncode == 0, result.stdout + result.stderr
    report = json.loads(output.read_text())
    assert report["passed"] and report["date"] and report["gpu"] is None and report["agreement"]["same_bits"]
    assert report["agreement"]["gradients"].keys() == {"means", "quats", "scales", "opacities", "sh_dc", "sh_rest"}
    moving = report["frames"]["control-points"]
    assert (
        all(moving["same_bits"])
        and all(moving["checks"].values())
        and {"frame 4", "room grew", "recorded", "cpu"} < moving["checks"].keys()
    )
    assert report["forms"]["tiny/cpu"]["both"]["ms_median"] > 0
    assert report["raster"]["small"]["both"]["ms_median"] > 0 and report["raster"]["small"]["pairs"] > 100
    assert len(report["dynamic"]["table_s2"]) == len(report["dynamic"]["rows"]) == 4
    assert 0 < report["dynamic"]["motion_share"] < 1
    assert {"step", "step/arap"} <= {row["name"] for row in report["step"]["rows"]}
    assert report["fuzz"]["cases"] == 40 and report["crowded"]["passed"]


def test_out_of_time_is_a_failure_that_says_so(tmp_path: Path):
    output = tmp_path / "report.json"
    assert run("--parts", "agreement,tests", "--seconds", "0", "--output", output).returncode == 1
    report = json.loads(output.read_text())
    assert not report["passed"] and report["tests"]["error"] == "no time left"
    assert run("--parts", "agreement,nonsense").returncode == 2


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module("gpu_check")


@pytest.fixture
def trust(script: ModuleType) -> ModuleType:
    return importlib.import_module("gpu_trust")


@pytest.mark.slow
def test_a_process_group_of_one(trust: ModuleType, monkeypatch: pytest.MonkeyPatch):
    made, init = [], dist.init_process_group
    monkeypatch.setattr(dist, "init_process_group", lambda *args, **kwargs: (made.append(args), init(*args, **kwargs)))
    assert trust.share("cpu")["same_bits"]
    assert made == [("gloo",)], "one process would train without a group"


def test_outcomes_before_a_time_out_count(trust: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    lines = ["import time"] + [f"def test_{name}(): {body}" for name, body in BODIES.items()]
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_slow_cuda.py").write_text("\n".join(lines))
    monkeypatch.setattr(trust, "ROOT", tmp_path)
    report = trust.tests(False, seconds=8.0)
    assert not report["passed"] and not report["in_time"] and report["tests_passed"] == 1
    assert report["failures"] == ["tests/test_slow_cuda.py::test_bad"]


def test_its_checks_can_fail(script: ModuleType):
    image = torch.rand(4, 50, 50)
    assert script.compare_images(image, image)["passed"]
    flipped = image.clone()
    flipped[0, 3, 3] += 1 / 255
    assert script.compare_images(image, flipped)["passed"]
    flipped[0, 3, 3] += 0.1
    assert not script.compare_images(image, flipped)["passed"]
    assert not script.compare_images(image, image + 2e-4)["passed"]
    assert not script.compare_images(image, torch.full_like(image, float("nan")))["passed"]
    gradient = torch.rand(200, 3) + 0.1
    assert script.compare_gradients(gradient, gradient)["passed"]
    assert not script.compare_gradients(gradient, 1.1 * gradient)["passed"]


def test_what_breaks_leaves_its_trace(script: ModuleType):
    report = {}
    script.attempt("broken", report, lambda: 1 / 0)
    assert not report["broken"]["passed"] and "ZeroDivisionError" in report["broken"]["error"]
    assert "test_gpu_check.py" in report["broken"]["trace"]


def test_a_frame_that_lacks_splats_is_noticed(script: ModuleType, monkeypatch: pytest.MonkeyPatch):
    setting = script.setting("cpu", True)
    assert script.frames_of("static", setting)["passed"]
    monkeypatch.setattr(FrameGraph, "finish", lambda self, pending: pending.image)
    report = script.frames_of("static", setting)
    assert not report["passed"] and not report["checks"]["frame 4"] and not report["checks"]["room grew"]
