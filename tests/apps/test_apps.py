"""Every app as a user runs it: --help, the smallest real run, and mistakes in one line with status 2."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from helpers.paths import ROOT
from helpers.tiny import write_dnerf

APPS = ["train", "evaluate", "view", "bench", "ablate", "synthesize", "capture", "export"]
SMALL = ["--preset", "cpu", "--set", "motion.layers=3", "--set", "motion.width=32", "--set", "motion.skip=2",
         "--set", "init_points=300", "--nodes", "16", "--device", "cpu"]  # fmt: skip


def run(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess:
    app, *rest = arguments
    command = [sys.executable, str(ROOT / "apps" / f"{app}.py"), *rest]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=300)


@pytest.fixture(scope="module")
def dnerf(tmp_path_factory) -> Path:
    """A tiny D-NeRF folder on disk."""
    return write_dnerf(tmp_path_factory.mktemp("data") / "blobs")


@pytest.fixture(scope="module")
def trained(dnerf, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("runs") / "run"
    done = run("train", "--data", str(dnerf), "--output", str(output), "--steps", "60", *SMALL)
    assert done.returncode == 0, done.stderr
    return output


@pytest.mark.parametrize("app", APPS)
def test_help(app):
    done = run(app, "--help")
    assert done.returncode == 0
    assert "--device" in done.stdout or "frame" in done.stdout


def test_training_leaves_everything(trained):
    metrics = json.loads((trained / "metrics.json").read_text())
    keys = ("psnr ssim lpips split images step seconds gaussians control_points motion device data downscale resample "
            "background seed").split()  # fmt: skip
    assert set(keys) <= set(metrics)
    assert metrics["step"] == 60 and metrics["images"] == 3 and metrics["lpips"] is None
    for name in ("checkpoint.safetensors", "log.jsonl", "contact_sheet.png", "curves.png", "turntable.mp4",
                 "previews/latest.png"):  # fmt: skip
        assert (trained / name).stat().st_size > 100, name


def test_its_config_can_be_given_back(trained, tmp_path):
    output = tmp_path / "again"
    done = run("train", "--config", str(trained / "config.json"), "--output", str(output), "--device", "cpu")
    assert done.returncode == 0, done.stderr
    first, second = ((folder / "checkpoint.safetensors").read_bytes() for folder in (trained, output))
    assert first == second


def test_evaluate(trained, tmp_path):
    path = tmp_path / "metrics.json"
    done = run("evaluate", "--run", str(trained), "--json", str(path), "--device", "cpu")
    assert done.returncode == 0, done.stderr
    assert json.loads(path.read_text())["psnr"] == json.loads((trained / "metrics.json").read_text())["psnr"]


@pytest.mark.parametrize("show", ["rgb", "trajectories"])
def test_view(trained, tmp_path, show):
    output = tmp_path / "film.gif"
    done = run("view", "--run", str(trained), "--frames", "3", "--size", "32", "--show", show, "--output", str(output))
    assert done.returncode == 0, done.stderr
    assert output.stat().st_size > 100


def test_console_script():
    done = subprocess.run([sys.executable, "-m", "scgs_warp.apps", "view", "--help"], capture_output=True, text=True)
    assert done.returncode == 0 and "--output" in done.stdout
    done = subprocess.run([sys.executable, "-m", "scgs_warp.apps", "nonsense"], capture_output=True, text=True)
    assert done.returncode == 2


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
    import shutil

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
    import torch

    if kind == "cuda without a GPU" and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    done = run("train", "--output", str(tmp_path / "run"), "--steps", "20", *broken(kind, dnerf, tmp_path))
    assert done.returncode == 2, done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1 and named in lines[0], done.stderr


def test_a_run_that_is_no_run(tmp_path):
    for app in ("evaluate", "view"):
        extra = ["--output", str(tmp_path / "a.gif")] if app == "view" else []
        done = run(app, "--run", str(tmp_path), *extra)
        assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr


def test_a_reader_that_stops_reading_is_no_error(trained):
    """``... | head -1`` closes the pipe."""
    command = f"{sys.executable} {ROOT / 'apps/train.py'} --help | head -1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, env=dict(os.environ))
    assert "Traceback" not in done.stderr


def test_the_console_script_lists_its_commands(monkeypatch, capsys):
    from scgs_warp.apps import __main__ as console

    for arguments, status in ([], 0), (["--help"], 0), (["exprot"], 2):
        monkeypatch.setattr(sys, "argv", ["scgs-warp", *arguments])
        assert console.main() == status
        said = capsys.readouterr()
        assert all(name in (said.err if status else said.out) for name in console.APPS)
    folder = Path(console.__file__).parent
    assert all((folder / f"{name}.py").is_file() for name in console.APPS)
