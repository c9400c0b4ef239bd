"""apps/train.py as a user runs it: the smallest real run, interrupts, and mistakes in one line with status 2."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from helpers.app_runs import SMALL, run_app
from helpers.paths import ROOT


def test_training_leaves_everything(trained):
    metrics = json.loads((trained / "metrics.json").read_text())
    keys = ("psnr ssim lpips split images step seconds gaussians control_points motion device data downscale resample "
            "background seed").split()  # fmt: skip
    assert set(keys) <= set(metrics)
    assert metrics["step"] == 60 and metrics["images"] == 3 and metrics["lpips"] is None
    assert metrics["psnr_worst"] <= metrics["psnr_median"] and 0 <= metrics["missing"] <= 1, "the images have alpha"
    origin = metrics["provenance"]
    assert origin["command"].startswith("python apps/train.py --data ") and origin["machine"]["processor"]
    assert "/" not in origin["command"].removeprefix("python apps/"), "a path of this machine"
    for name in ("checkpoint.safetensors", "log.jsonl", "contact_sheet.png", "curves.png", "turntable.mp4",
                 "previews/latest.png"):  # fmt: skip
        assert (trained / name).stat().st_size > 100, name


def test_its_config_can_be_given_back(trained, tmp_path):
    output = tmp_path / "again"
    done = run_app("train", "--config", str(trained / "config.json"), "--output", str(output), "--device", "cpu")
    assert done.returncode == 0, done.stderr
    first, second = ((folder / "checkpoint.safetensors").read_bytes() for folder in (trained, output))
    assert first == second


def test_the_default_output_is_named_after_what_the_configuration_names(trained, tmp_path, monkeypatch):
    """Not after the built-in scene, whose run it would stand in for."""
    monkeypatch.chdir(tmp_path)
    content = json.loads((trained / "config.json").read_text())
    (tmp_path / "part.json").write_text(json.dumps({"preset": content["preset"], "data": content["data"]}))
    for file in (trained / "config.json", tmp_path / "part.json"):
        done = run_app("train", "--config", str(file), "--steps", "20", *SMALL)
        assert done.returncode == 0, done.stderr
        run = f"runs/blobs-{content['preset']}"
        assert f"{run}: metrics.json" in done.stdout
        assert f"next: python apps/view.py --run {run} " in done.stdout
        shutil.rmtree("runs")


def test_interrupted_from_the_terminal_and_resumed(dnerf, tmp_path):
    output = tmp_path / "run"
    options = ["--data", str(dnerf), "--output", str(output), "--steps", "4000", *SMALL]
    command = [sys.executable, str(ROOT / "apps/train.py"), *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    log = output / "log.jsonl"
    for _ in range(600):
        time.sleep(0.1)
        if log.is_file() and log.stat().st_size > 300:
            break
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert (output / "checkpoint.safetensors").is_file()


def broken(kind: str, dnerf: Path, folder: Path) -> list[str]:
    """Arguments of a train run that cannot work."""
    if kind == "missing folder":
        return ["--data", str(folder / "nowhere")]
    copy = folder / "data"
    shutil.copytree(dnerf, copy)
    path = copy / "transforms_train.json"
    content = json.loads(path.read_text())
    if kind == "no frames":
        content["frames"] = []
    elif kind == "NaN pose":
        content["frames"][1]["transform_matrix"][0][3] = float("nan")
    elif kind == "broken image":
        (copy / "train/train_002.png").write_bytes(b"not a picture")
    path.write_text(json.dumps(content) if kind != "broken JSON" else "{")
    extra = {"cuda without a GPU": ["--device", "cuda"], "unknown field": ["--set", "motion.speed=3"]}
    return ["--data", str(copy), *extra.get(kind, [])]


@pytest.mark.parametrize(
    ("kind", "named"),
    [
        ("missing folder", "nowhere"),
        ("no frames", "frames"),
        ("broken JSON", "transforms_train.json"),
        ("NaN pose", "transform_matrix"),
        ("broken image", "train_002.png"),
        ("unknown field", "motion.speed"),
        ("cuda without a GPU", "--device cuda"),
    ],
)
def test_mistakes_get_one_line_and_status_2(kind, named, dnerf, tmp_path):
    if kind == "cuda without a GPU" and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    done = run_app("train", "--output", str(tmp_path / "run"), "--steps", "20", *broken(kind, dnerf, tmp_path))
    assert done.returncode == 2, done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1 and named in lines[0], done.stderr
