"""Cells in worker processes of this machine."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from helpers.cells import options
from helpers.paths import ROOT
from helpers.tiny import write_dnerf
from scgs_warp.apps import ablate as app


@pytest.fixture(scope="module")
def blobs(tmp_path_factory) -> Path:
    return write_dnerf(tmp_path_factory.mktemp("data") / "blobs", 32)


def test_a_failing_cell_stops_no_other(blobs, tmp_path, capsys):
    """In processes of their own: the reason comes back from there, too."""
    broken = Path(shutil.copytree(blobs, tmp_path / "broken"))
    (broken / "train/train_002.png").write_bytes(b"not a picture")
    output = tmp_path / "out"
    data = ["--data", str(broken), str(blobs), "--jobs", "2"]
    assert app.cli(["nodes", *options(blobs, output, "--values", "8"), *data]) == 2
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1 and "1 of 2 cells failed: broken/8 (" in lines[0] and "train_002.png" in lines[0]
    report = json.loads((output / "nodes.json").read_text())
    assert [cell["metrics"] is None for cell in report["cells"]] == [True, False]
    assert "training 30/30" in (output / "blobs/8/train.log").read_text()


def test_stopped_from_outside_and_resumed(blobs, tmp_path):
    """Two processes are told, and save; the same command goes on from there."""
    output = tmp_path / "out"
    arguments = ["nodes", *options(blobs, output, "--values", "8,16", "--jobs", "2", steps=1_000)]
    command = [sys.executable, str(ROOT / "apps/ablate.py"), *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    logs = {value: output / "blobs" / value / "log.jsonl" for value in ("8", "16")}
    begun: list[str] = []
    while not begun:
        assert process.poll() is None
        time.sleep(0.05)
        begun = [value for value, log in logs.items() if log.is_file() and log.stat().st_size > 300]
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    folder, log = output / "blobs" / begun[0], logs[begun[0]]
    assert (folder / "checkpoint.safetensors").is_file() and not (folder / "metrics.json").is_file()
    before = log.read_text().splitlines()
    assert app.cli(["nodes", *options(blobs, output, "--values", begun[0], steps=1_000)]) == 0
    assert log.read_text().splitlines()[: len(before)] == before, "continued, not begun again"
    assert json.loads((folder / "metrics.json").read_text())["step"] == 1_000
