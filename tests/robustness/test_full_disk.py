"""Training on disks that are full, read-only or gone: one line, the last checkpoint intact, the same bits after
``--resume``; logs, previews and event files are given up instead (docs/trust.md)."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path

import pytest
import torch

from helpers import fault_runs
from helpers.fault_runs import (
    FAULT_STEP,
    FRAMES,
    STEPS,
    checkpoint_bytes,
    config,
    every_step,
    refusal,
    resume,
    warnings,
)
from helpers.full_disk import FakeDisk, nothing_may_be_written, small_disk
from helpers.tiny import tiny_dataset
from scgs_warp.data import load
from scgs_warp.errors import UserError
from scgs_warp.scene.scene import Scene
from scgs_warp.storage import checkpoint, files
from scgs_warp.training import run as training_run
from scgs_warp.training import run_folder
from scgs_warp.training.loop import fit
from scgs_warp.training.run_folder import RunFolder
from scgs_warp.visualization import video

at_step, done, images, whole = fault_runs.at_step, fault_runs.done, fault_runs.images, fault_runs.whole


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO])
def test_checkpoint_that_cannot_be_written_ends_the_run(number, tmp_path, monkeypatch, at_step, whole):
    disk = FakeDisk(monkeypatch, ("checkpoint.safetensors",), number)
    at_step(FAULT_STEP, lambda: setattr(disk, "full", True))
    line = refusal(tmp_path / "run", every_step())
    assert "checkpoint.safetensors" in line and os.strerror(number) in line and "--resume" in line
    assert checkpoint.read(tmp_path / "run")[1]["step"] == FAULT_STEP
    assert not list((tmp_path / "run").glob(".*.tmp"))
    disk.full = False
    assert resume(tmp_path / "run") == whole


def test_first_checkpoint_that_cannot_be_written(tmp_path, monkeypatch, at_step, whole):
    disk = FakeDisk(monkeypatch, ("checkpoint.safetensors",))
    disk.full = True
    assert "nothing is saved yet" in refusal(tmp_path / "run", every_step())
    disk.full = False
    assert resume(tmp_path / "run") == whole, "a run without a checkpoint begins again"


def test_real_full_disk(tmp_path, at_step, whole):
    with small_disk(tmp_path / "small", 8) as disk:
        run = disk.folder / "run"
        # Without this the next checkpoint would take the room of the previous one until the scene grows.
        at_step(FAULT_STEP, lambda: [(run / checkpoint.PREVIOUS).unlink(), disk.fill()])
        line = refusal(run, every_step())
        assert "No space left on device" in line and "checkpoint.safetensors" in line
        assert checkpoint.read(run)[1]["step"] == FAULT_STEP
        with pytest.raises(UserError, match="cannot be written"):
            resume(run)
        assert Scene.load(run).step == FAULT_STEP
        disk.free()
        assert resume(run) == whole


def test_folder_that_becomes_read_only(at_step, whole):
    with tempfile.TemporaryDirectory() as place, ExitStack() as stack:
        Path(place).chmod(0o755)
        at_step(FAULT_STEP, lambda: stack.enter_context(nothing_may_be_written(Path(place, "run"))))
        line = refusal(Path(place, "run"), every_step())
        stack.close()
        assert "Permission denied" in line and "--resume continues from there" in line
        assert checkpoint.read(Path(place, "run"))[1]["step"] == FAULT_STEP
        assert resume(Path(place, "run")) == whole


def test_real_disk_full_between_two_checkpoints(tmp_path, at_step, whole, capfd, monkeypatch):
    """Log, previews and event files fail meanwhile; the run goes on without them."""
    pytest.importorskip("tensorboard")
    monkeypatch.setattr(run_folder, "LOG_EVERY", 5)
    monkeypatch.setattr(run_folder, "PREVIEW_SECONDS", 0.0)
    with small_disk(tmp_path / "small", 8) as disk:
        at_step(FAULT_STEP, disk.fill)
        at_step(FAULT_STEP + 15, disk.free)
        fit(config(), tiny_dataset(FRAMES), output=disk.folder / "run", tensorboard=True)
        assert checkpoint_bytes(disk.folder / "run") == whole
        lines = (disk.folder / "run/log.jsonl").read_text().splitlines()
    said = capfd.readouterr()
    told = warnings(said.out)
    assert len(told) in (2, 3) and "previews" in str(told) and "event files" in str(told), said  # a short log has room
    assert "Traceback" not in said.err
    steps = [json.loads(line)["step"] for line in lines if line.endswith("}")]
    assert steps[:4] == [5, 10, 15, 20] and steps[-1] == STEPS


def test_deleted_run_folder(tmp_path, at_step):
    at_step(FAULT_STEP, lambda: shutil.rmtree(tmp_path / "run"))
    assert "No such file" in refusal(tmp_path / "run", every_step())


def test_disk_with_room_for_two_checkpoints(tmp_path, monkeypatch, whole):
    plain = files.write_and_flush

    def third(path: Path, content: bytes) -> None:
        if path.with_name(checkpoint.PREVIOUS).exists():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        plain(path, content)

    monkeypatch.setattr(files, "write_and_flush", third)
    fit(every_step(), tiny_dataset(FRAMES), output=tmp_path / "run")
    assert checkpoint_bytes(tmp_path / "run") == whole


@pytest.mark.parametrize("links", [True, False])
def test_previous_checkpoint_is_kept(links, tmp_path, monkeypatch):
    if not links:
        monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(OSError(errno.EPERM, "no links here")))
    fit(every_step(), tiny_dataset(FRAMES), output=tmp_path)
    steps = [checkpoint.read(tmp_path, name=name)[1]["step"] for name in (checkpoint.FILE, checkpoint.PREVIOUS)]
    assert steps == [STEPS, STEPS - 1]
    assert sorted(path.name for path in tmp_path.glob(".*")) == [".lock"]


def test_files_are_flushed_before_and_after_a_rename(tmp_path, monkeypatch):
    done: list[str] = []
    fsync, replace = os.fsync, os.replace

    def flush(number: int) -> None:
        done.append("folder" if os.path.isdir(f"/proc/self/fd/{number}") else "file")
        fsync(number)

    def rename(source: Path, target: Path) -> None:
        done.append(f"rename {Path(target).name}")
        replace(source, target)

    if not Path("/proc/self/fd").is_dir():
        pytest.skip("no /proc")
    monkeypatch.setattr(os, "fsync", flush)
    monkeypatch.setattr(os, "replace", rename)
    for _ in range(2):
        checkpoint.write(tmp_path, {"a": torch.zeros(3)}, {})
    newest = f"rename {checkpoint.FILE}"
    assert done == ["file", newest, "folder", "file", f"rename {checkpoint.PREVIOUS}", newest, "folder"]
    done.clear()
    files.write_atomically(tmp_path / "a.json", b"{}")
    assert done == ["file", "rename a.json", "folder"]


@pytest.mark.parametrize(("name", "what"), [("log.jsonl", "log lines"), ("latest.png", "previews")])
def test_logs_and_previews_may_fail(name, what, tmp_path, monkeypatch, at_step, whole, capsys):
    monkeypatch.setattr(run_folder, "LOG_EVERY", 5)
    monkeypatch.setattr(run_folder, "PREVIEW_SECONDS", 0.0)
    disk = FakeDisk(monkeypatch, (name,))
    at_step(FAULT_STEP, lambda: setattr(disk, "full", True))
    at_step(FAULT_STEP + 12, lambda: setattr(disk, "full", False))
    fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run")
    assert checkpoint_bytes(tmp_path / "run") == whole
    (said,) = warnings(capsys.readouterr().out)
    assert what in said and "No space left on device" in said
    steps = [json.loads(line)["step"] for line in (tmp_path / "run/log.jsonl").read_text().split("\n") if line]
    assert steps == ([5, 10, 15, 20, 35, 40] if name == "log.jsonl" else list(range(5, 41, 5)))


def test_event_files_may_fail(tmp_path, monkeypatch, at_step, whole, capfd):
    writer = pytest.importorskip("tensorboard.summary.writer.record_writer").RecordWriter
    monkeypatch.setattr(run_folder, "LOG_EVERY", 2)

    def full(self, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    at_step(FAULT_STEP, lambda: monkeypatch.setattr(writer, "write", full))
    fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run", tensorboard=True)
    assert checkpoint_bytes(tmp_path / "run") == whole
    said = capfd.readouterr()
    assert len(warnings(said.out)) == 1 and "Traceback" not in said.err, said


PICTURES = ["contact_sheet.png", "curves.png", "test_001.png", "metrics.json", "turntable.mp4"]


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_and_metrics_that_cannot_be_written(name, done, tmp_path, monkeypatch):
    data, run = done[0], tmp_path / "run"
    shutil.copytree(done[1], run)
    (run / "metrics.json").unlink()
    before = checkpoint_bytes(run)

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
        training_run.train_and_evaluate(config(), data, run, frames=2, resume=True)
    assert name in str(caught.value) and not (run / "metrics.json").exists() and checkpoint_bytes(run) == before
    monkeypatch.undo()
    training_run.train_and_evaluate(config(), data, run, frames=2, resume=True)
    assert (run / "metrics.json").exists() and checkpoint_bytes(run) == before


def test_real_disk_full_after_training(done, tmp_path):
    with small_disk(tmp_path / "small", 8) as disk:
        run = disk.folder / "run"
        shutil.copytree(done[1], run, ignore=shutil.ignore_patterns("evaluation", "*.mp4", "metrics.json", "c*.png"))
        scene, test = Scene.load(run), load(done[0], "test")
        disk.fill()
        with pytest.raises(UserError, match="No space left on device"):
            training_run.write_results(scene, test, run, frames=2)
        assert not (run / "metrics.json").exists()
        disk.free()
        training_run.write_results(scene, test, run, frames=2)
        assert (run / "metrics.json").stat().st_size > 100


def test_run_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    folder = RunFolder(tmp_path / "file/run", config(), None, resume=False)
    with pytest.raises(UserError, match="choose another --output"), folder:
        pass
