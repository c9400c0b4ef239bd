"""The script for machines with a GPU works, tried small on the CPU; and its checks can fail."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import torch

SCRIPT = Path(__file__).resolve().parent.parent / "benchmarks" / "gpu_check.py"


def test_quick_run_on_the_cpu(tmp_path):
    output = tmp_path / "report.json"
    result = subprocess.run(
        [sys.executable, SCRIPT, "--device", "cpu", "--quick", "--no-tests", "--output", output],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    report = json.loads(output.read_text())
    assert report["passed"] and report["date"] and report["agreement"]["passed"] and report["same_bits"]["passed"]
    assert report["agreement"]["gradients"].keys() == {"means", "quats", "scales", "opacities", "sh_dc", "sh_rest"}
    assert report["time/tiny"]["ours"]["both"]["ms_median"] > 0


def test_its_checks_can_fail():
    spec = importlib.util.spec_from_file_location("gpu_check", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
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
    report = {}
    script.attempt("broken", report, lambda: 1 / 0)
    assert not report["broken"]["passed"] and "ZeroDivisionError" in report["broken"]["error"]
