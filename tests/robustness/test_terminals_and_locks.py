"""Closed terminals, closed pipes and second trainers: training stops with a checkpoint, goes on, or is refused
(docs/trust.md)."""

from __future__ import annotations

import errno
import json
import os
import select
import signal
import subprocess
import sys
import time

import pytest

from helpers import fault_runs
from helpers.fault_runs import (
    FAULT_STEP,
    FRAMES,
    checkpoint_bytes,
    config,
    resume,
)
from helpers.paths import ROOT
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.apps import cli
from scgs_warp.config.presets import to_dict
from scgs_warp.storage import checkpoint
from scgs_warp.training.loop import fit

at_step, done, images, whole = fault_runs.at_step, fault_runs.done, fault_runs.images, fault_runs.whole


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP here")
def test_closed_terminal_saves_a_checkpoint(tmp_path, at_step, whole):
    """The shell and the system both send SIGHUP."""
    at_step(FAULT_STEP, lambda: [os.kill(os.getpid(), signal.SIGHUP) for _ in range(2)])
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests themselves may run under nohup
    try:
        with pytest.raises(KeyboardInterrupt):
            fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run")
    finally:
        signal.signal(signal.SIGHUP, before)
    assert checkpoint.read(tmp_path / "run")[1]["step"] == FAULT_STEP + 1
    assert resume(tmp_path / "run") == whole


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals of this kind here")
def test_real_terminal_that_closes(tmp_path, images):
    import fcntl
    import termios

    def take_it() -> None:
        os.setsid()
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    terminal, inside = os.openpty()
    (tmp_path / "config.json").write_text(json.dumps(to_dict(tiny_config(4000))))
    run, script = tmp_path / "run", ROOT / "apps/train.py"
    options = ["--data", str(images), "--config", str(tmp_path / "config.json"), "--output", str(run)]
    command = [sys.executable, str(script), *options, "--device", "cpu"]
    process = subprocess.Popen(command, stdin=inside, stdout=inside, stderr=inside, preexec_fn=take_it)
    os.close(inside)
    end, log = time.monotonic() + 300, run / "log.jsonl"
    while time.monotonic() < end and process.poll() is None and not (log.is_file() and log.stat().st_size):
        if select.select([terminal], [], [], 0.1)[0]:
            os.read(terminal, 65536)
    os.close(terminal)
    assert process.wait(timeout=300) == 130
    assert checkpoint.read(run)[1]["step"] > 0


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP here")
def test_nohup_trains_on(tmp_path, at_step, whole):
    at_step(FAULT_STEP, lambda: os.kill(os.getpid(), signal.SIGHUP))
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run")
    finally:
        signal.signal(signal.SIGHUP, before)
    assert checkpoint_bytes(tmp_path / "run") == whole


def test_closed_pipe_trains_on(done, tmp_path, monkeypatch):
    """As behind ``| head -1``."""
    from scgs_warp.apps import train as app

    reader, writer = os.pipe()
    os.close(reader)
    arguments = ["--data", str(done[0]), "--config", str(done[1] / "config.json"), "--device", "cpu"]
    with open(writer, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        assert app.cli([*arguments, "--output", str(tmp_path / "run")]) == 0
        monkeypatch.undo()
    assert checkpoint_bytes(tmp_path / "run") == checkpoint_bytes(done[1]) and (tmp_path / "run/metrics.json").exists()


def test_table_for_a_reader_that_is_gone(monkeypatch):
    """rich alone would end the program with status 1."""
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        assert cli.run(lambda _: cli.print_parts("a table")) == 0
        monkeypatch.undo()


def test_no_standard_output(tmp_path, monkeypatch, whole):
    monkeypatch.setattr(sys, "stdout", None)
    fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run")
    assert checkpoint_bytes(tmp_path / "run") == whole


def test_second_trainer_is_refused(done, tmp_path, at_step, capsys, whole):
    from scgs_warp.apps import train as app

    output, said = tmp_path / "run", []

    def second() -> None:
        arguments = ["--data", str(done[0]), "--config", str(done[1] / "config.json"), "--device", "cpu"]
        capsys.readouterr()
        for more in ([], ["--resume"]):
            said.append((app.cli([*arguments, "--output", str(output), *more]), capsys.readouterr().err))

    at_step(FAULT_STEP, second)
    fit(config(), tiny_dataset(FRAMES), output=output)
    for status, line in said:
        assert status == 2 and line.count("\n") == 1 and "another trainer is running here" in line, said
    assert len(said) == 2 and checkpoint_bytes(output) == whole


def test_file_system_without_locks(tmp_path, monkeypatch, whole):
    fcntl = pytest.importorskip("fcntl")

    def unsupported(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", unsupported)
    fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run")
    assert checkpoint_bytes(tmp_path / "run") == whole
