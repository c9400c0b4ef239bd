"""The chaos run (benchmarks/chaos.py): it tells a loss from an end that was asked for."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from helpers.paths import ROOT

if not hasattr(os, "fork"):
    pytest.skip("children that begin at once need fork", allow_module_level=True)
sys.path.insert(0, str(ROOT / "benchmarks"))

chaos = pytest.importorskip("chaos")
chaos_work = pytest.importorskip("chaos_work")


def fault(kind: str, folder: Path, mounted: bool = True):
    return chaos.Fault(kind, random.Random(0), folder, mounted)


@pytest.mark.parametrize(
    ("kind", "status", "allowed"),
    [
        ("none", 0, True), ("none", 2, False), ("none", None, False), ("none", -11, False), ("slow disk", 2, False),
        ("kill", -9, True), ("kill", -15, False), ("kill", 1, False), ("terminate", 130, True),
        ("terminate", -15, True), ("hang up", -1, True), ("full disk", 2, True), ("full disk", 1, False),
        ("memory", 2, True), ("memory", -9, False), ("rival", 2, True), ("clock", 0, True), ("clock", 2, False),
    ],
)  # fmt: skip
def test_an_end_is_allowed_where_the_fault_asks_for_it(tmp_path, kind, status, allowed):
    assert fault(kind, tmp_path).allows(status) is allowed


def test_a_child_is_an_app(tmp_path):
    """A mistake is one line and status 2; a traceback is none of it."""
    from scgs_warp.errors import UserError

    def refuse() -> None:
        raise UserError("no")

    def fail() -> None:
        raise KeyError("x")

    log = tmp_path / "log"
    assert chaos.end(chaos.begin(lambda: None, log)) == 0
    assert chaos.end(chaos.begin(refuse, log)) == 2 and log.read_text() == "error: no\n"
    assert chaos.end(chaos.begin(fail, log)) == 70 and "KeyError" in log.read_text()
    assert chaos.end(chaos.begin(signal.pause, log), 0.5) is None, "a process that hangs is ended"
    with pytest.raises(RuntimeError, match="undisturbed work ended with 2: error: no"):
        chaos.finish(refuse, log)


def test_a_slow_child_does_not_hang(tmp_path, monkeypatch):
    """Where other programs take the processor, a child needs any time; one that only loops is ended."""
    monkeypatch.setattr(chaos, "LEAST_WORK", 0.02)
    assert chaos.end(chaos.begin(lambda: work_for(4.0), tmp_path / "log"), 2.0) == 0
    monkeypatch.setattr(chaos, "MOST_WORK", 0.3)
    assert chaos.end(chaos.begin(lambda: work_for(1e9), tmp_path / "log"), 1e9) is None


def work_for(seconds: float) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        pass


def test_a_signal_meets_a_child_that_works(tmp_path):
    def leak(number: int, frame: Any) -> None:
        raise RuntimeError("a handler of the parent's")

    before = signal.signal(signal.SIGTERM, leak)
    try:
        child = chaos.begin(signal.pause, tmp_path / "log")
    finally:
        signal.signal(signal.SIGTERM, before)
    struck = fault("terminate", tmp_path)
    struck.outside(child, 0.1)
    assert struck.allows(chaos.end(child))


def test_broken_exports_are_noticed(tmp_path):
    whole = tmp_path / "whole.ply"
    whole.write_bytes(b"all of it")
    work = chaos_work.Exporting(tmp_path, tmp_path, {".ply": chaos_work.digest(whole)})
    work.folder.mkdir()
    (work.folder / "scene.ply").write_bytes(whole.read_bytes())
    (work.folder / ".scene.ply.0123abcd.tmp").write_bytes(b"half")
    assert work.check(-9) == []
    (work.folder / "scene.ply").write_bytes(b"all of")
    assert work.check(-9) == ["scene.ply is not what an undisturbed export writes"]


def test_a_lost_step_is_noticed(tmp_path):
    from scgs_warp.storage import checkpoint

    work = chaos_work.Training(tmp_path, tmp_path, tmp_path / "reference")
    work.run.mkdir()
    for step in (1, 5):
        checkpoint.write(work.run, {}, {"step": step})
    assert work.check(-9) == []
    (work.run / checkpoint.FILE).write_bytes(b"half")
    first, second = work.check(-9)
    assert "damaged or not ours" in first and second == "step 5 was saved, and 1 is left"
    (work.run / checkpoint.PREVIOUS).unlink()
    assert "no checkpoint is sound" in work.check(-9)


def test_the_summary_lists_what_is_broken():
    rounds = [
        {"part": "export", "fault": "kill", "status": [-9], "broken": []},
        {"part": "export", "fault": "kill", "status": [-9], "broken": ["a.ply is not whole"]},
    ]
    found = chaos.summary(rounds)
    assert found["rounds"] == 2 and found["faults"]["export"] == {"kill": 2}
    assert found["broken"] == ["export, kill: a.ply is not whole"]


@pytest.mark.slow
def test_three_minutes_of_chaos(tmp_path):
    command = [sys.executable, str(ROOT / "benchmarks/chaos.py"), "--minutes", "3", "--json", str(tmp_path / "a.json")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["broken"] == [] and report["rounds"] >= 8
