"""Disks that are full after training, terminals that are closed, other trainers: ``test_faults.py`` continued."""

from __future__ import annotations

import errno
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from helpers import fault_runs
from helpers.fault_runs import FRAMES, HERE, bits, config, go_on
from helpers.full_disk import FakeDisk, small_disk
from helpers.paths import ROOT
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.config.presets import to_dict
from scgs_warp.data import load
from scgs_warp.errors import UserError
from scgs_warp.scene.scene import Scene
from scgs_warp.storage import checkpoint
from scgs_warp.training import run as finish
from scgs_warp.training.loop import fit
from scgs_warp.training.run_folder import RunFolder
from scgs_warp.visualization import video

at_step, done, images, whole = fault_runs.at_step, fault_runs.done, fault_runs.images, fault_runs.whole


# After training


PICTURES = ["contact_sheet.png", "curves.png", "test_001.png", "metrics.json", "turntable.mp4"]


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_and_scores_that_cannot_be_written(name, done, tmp_path, monkeypatch):
    data, run = done[0], tmp_path / "run"
    shutil.copytree(done[1], run)
    (run / "metrics.json").unlink()
    before = bits(run)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    disk = FakeDisk(monkeypatch, (name,))
    disk.full = True
    opened = Path.open

    def path_open(self, mode="r", *rest, **fields):
        return disk.open(self, mode) if "w" in mode and name in self.name else opened(self, mode, *rest, **fields)

    monkeypatch.setattr(Path, "open", path_open)
    if name.endswith(".mp4"):
        monkeypatch.setattr(video._Mp4, "_write", full)
    with pytest.raises(UserError, match=r"No space left on device.*--resume makes the missing") as caught:
        finish.train_and_evaluate(config(), data, run, frames=2, resume=True)
    assert name in str(caught.value) and not (run / "metrics.json").exists() and bits(run) == before
    monkeypatch.undo()
    finish.train_and_evaluate(config(), data, run, frames=2, resume=True)
    assert (run / "metrics.json").exists() and bits(run) == before


def test_a_real_disk_that_is_full_after_training(done, tmp_path):
    with small_disk(tmp_path / "small", 8) as disk:
        run = disk.folder / "run"
        shutil.copytree(done[1], run, ignore=shutil.ignore_patterns("evaluation", "*.mp4", "metrics.json", "c*.png"))
        scene, test = Scene.load(run), load(done[0], "test")
        disk.fill()
        with pytest.raises(UserError, match="No space left on device"):
            finish.write_results(scene, test, run, frames=2)
        assert not (run / "metrics.json").exists()
        disk.free()
        finish.write_results(scene, test, run, frames=2)
        assert (run / "metrics.json").stat().st_size > 100


# Terminals, and other trainers


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no SIGHUP here")
def test_a_terminal_that_is_closed(tmp_path, at_step, whole):
    """The shell and the system both say so."""
    at_step(HERE, lambda: [os.kill(os.getpid(), signal.SIGHUP) for _ in range(2)])
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests themselves may run under nohup
    try:
        with pytest.raises(KeyboardInterrupt):
            fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run")
    finally:
        signal.signal(signal.SIGHUP, before)
    assert checkpoint.read(tmp_path / "run")[1]["step"] == HERE + 1
    assert go_on(tmp_path / "run") == whole


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals of this kind here")
def test_a_real_terminal_that_is_closed(tmp_path, images):
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
def test_nohup(tmp_path, at_step, whole):
    at_step(HERE, lambda: os.kill(os.getpid(), signal.SIGHUP))
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run")
    finally:
        signal.signal(signal.SIGHUP, before)
    assert bits(tmp_path / "run") == whole


def test_nobody_reads_the_output_any_more(done, tmp_path, monkeypatch):
    """As behind ``| head -1``: the run goes on to its end."""
    from scgs_warp.apps import train as app

    reader, writer = os.pipe()
    os.close(reader)
    arguments = ["--data", str(done[0]), "--config", str(done[1] / "config.json"), "--device", "cpu"]
    with open(writer, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        assert app.cli([*arguments, "--output", str(tmp_path / "run")]) == 0
        monkeypatch.undo()
    assert bits(tmp_path / "run") == bits(done[1]) and (tmp_path / "run/metrics.json").exists()


def test_no_terminal_at_all(tmp_path, monkeypatch, whole):
    monkeypatch.setattr(sys, "stdout", None)
    fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run")
    assert bits(tmp_path / "run") == whole


def test_a_second_trainer(done, tmp_path, at_step, capsys, whole):
    from scgs_warp.apps import train as app

    output, said = tmp_path / "run", []

    def second() -> None:
        arguments = ["--data", str(done[0]), "--config", str(done[1] / "config.json"), "--device", "cpu"]
        capsys.readouterr()
        for more in ([], ["--resume"]):
            said.append((app.cli([*arguments, "--output", str(output), *more]), capsys.readouterr().err))

    at_step(HERE, second)
    fit(config(), tiny_dataset(FRAMES), output=output)
    for status, line in said:
        assert status == 2 and line.count("\n") == 1 and "another trainer is running here" in line, said
    assert len(said) == 2 and bits(output) == whole


def test_a_file_system_without_locks(tmp_path, monkeypatch, whole):
    fcntl = pytest.importorskip("fcntl")

    def unsupported(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", unsupported)
    fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run")
    assert bits(tmp_path / "run") == whole


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    folder = RunFolder(tmp_path / "file/run", config(), None, resume=False)
    with pytest.raises(UserError, match="choose another --output"), folder:
        pass
