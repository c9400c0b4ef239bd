"""Disks, files and terminals that fail while a run goes on: one line, the last checkpoint intact, the same bits from
there; what a run can do without, it does without (docs/trust.md)."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import tempfile
from contextlib import ExitStack
from pathlib import Path

import pytest
import torch

from helpers import fault_runs
from helpers.fault_runs import FRAMES, HERE, STEPS, bits, config, go_on, often, refused, warnings
from helpers.full_disk import FakeDisk, nothing_may_be_written, small_disk
from helpers.tiny import tiny_dataset
from scgs_warp.data import load
from scgs_warp.errors import UserError
from scgs_warp.scene.scene import Scene
from scgs_warp.storage import checkpoint
from scgs_warp.training import run_folder
from scgs_warp.training.loop import fit

at_step, done, images, whole = fault_runs.at_step, fault_runs.done, fault_runs.images, fault_runs.whole


# Checkpoints


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO])
def test_a_checkpoint_that_cannot_be_written(number, tmp_path, monkeypatch, at_step, whole):
    disk = FakeDisk(monkeypatch, ("checkpoint.safetensors",), number)
    at_step(HERE, lambda: setattr(disk, "full", True))
    line = refused(tmp_path / "run", often())
    assert "checkpoint.safetensors" in line and os.strerror(number) in line and "--resume" in line
    assert checkpoint.read(tmp_path / "run")[1]["step"] == HERE
    assert not list((tmp_path / "run").glob(".*.tmp"))
    disk.full = False
    assert go_on(tmp_path / "run") == whole


def test_the_first_checkpoint_cannot_be_written(tmp_path, monkeypatch, at_step, whole):
    disk = FakeDisk(monkeypatch, ("checkpoint.safetensors",))
    disk.full = True
    assert "nothing is saved yet" in refused(tmp_path / "run", often())
    disk.full = False
    assert go_on(tmp_path / "run") == whole, "a run without a checkpoint begins again"


def test_a_real_disk_that_is_full(tmp_path, at_step, whole):
    with small_disk(tmp_path / "small", 8) as disk:
        run = disk.folder / "run"
        # else the previous one would make way for the next, until the scene grows
        at_step(HERE, lambda: [(run / checkpoint.PREVIOUS).unlink(), disk.fill()])
        line = refused(run, often())
        assert "No space left on device" in line and "checkpoint.safetensors" in line
        assert checkpoint.read(run)[1]["step"] == HERE
        with pytest.raises(UserError, match="cannot be written"):
            go_on(run)
        assert Scene.load(run).step == HERE
        disk.free()
        assert go_on(run) == whole


def test_a_folder_that_becomes_read_only(at_step, whole):
    with tempfile.TemporaryDirectory() as place, ExitStack() as stack:
        Path(place).chmod(0o755)
        at_step(HERE, lambda: stack.enter_context(nothing_may_be_written(Path(place, "run"))))
        line = refused(Path(place, "run"), often())
        stack.close()
        assert "Permission denied" in line and "--resume continues from there" in line
        assert checkpoint.read(Path(place, "run"))[1]["step"] == HERE
        assert go_on(Path(place, "run")) == whole


def test_a_real_disk_that_is_full_for_a_while(tmp_path, at_step, whole, capfd, monkeypatch):
    """Nobody saves meanwhile: log, previews and event files are not what a run ends for."""
    pytest.importorskip("tensorboard")
    monkeypatch.setattr(run_folder, "LOG_EVERY", 5)
    monkeypatch.setattr(run_folder, "PREVIEW_SECONDS", 0.0)
    with small_disk(tmp_path / "small", 8) as disk:
        at_step(HERE, disk.fill)
        at_step(HERE + 15, disk.free)
        fit(config(), tiny_dataset(FRAMES), output=disk.folder / "run", tensorboard=True)
        assert bits(disk.folder / "run") == whole
        lines = (disk.folder / "run/log.jsonl").read_text().splitlines()
    said = capfd.readouterr()
    told = warnings(said.out)
    assert len(told) in (2, 3) and "previews" in str(told) and "event files" in str(told), said  # a short log has room
    assert "Traceback" not in said.err
    steps = [json.loads(line)["step"] for line in lines if line.endswith("}")]
    assert steps[:4] == [5, 10, 15, 20] and steps[-1] == STEPS


def test_the_folder_of_the_run_is_deleted(tmp_path, at_step):
    at_step(HERE, lambda: shutil.rmtree(tmp_path / "run"))
    assert "No such file" in refused(tmp_path / "run", often())


def test_room_for_two_checkpoints_is_enough(tmp_path, monkeypatch, whole):
    plain = checkpoint._write_through

    def third(path: Path, content: bytes) -> None:
        if path.with_name(checkpoint.PREVIOUS).exists():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        plain(path, content)

    monkeypatch.setattr(checkpoint, "_write_through", third)
    fit(often(), tiny_dataset(FRAMES), output=tmp_path / "run")
    assert bits(tmp_path / "run") == whole


@pytest.mark.parametrize("links", [True, False])
def test_the_previous_checkpoint_is_kept(links, tmp_path, monkeypatch):
    if not links:
        monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(OSError(errno.EPERM, "no links here")))
    fit(often(), tiny_dataset(FRAMES), output=tmp_path)
    steps = [checkpoint.read(tmp_path, name=name)[1]["step"] for name in (checkpoint.FILE, checkpoint.PREVIOUS)]
    assert steps == [STEPS, STEPS - 1]
    assert sorted(path.name for path in tmp_path.glob(".*")) == [".lock"]


def test_what_cannot_be_read_now_may_be_sound(tmp_path, monkeypatch):
    """A read error is no damage: the newest checkpoint stays where it is."""
    fit(often(), tiny_dataset(FRAMES), output=tmp_path)
    before = bits(tmp_path)

    def stale(*_, **__):
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "safe_open", stale)
        with pytest.raises(UserError, match="cannot be read"):
            go_on(tmp_path)
    assert bits(tmp_path) == before and not (tmp_path / checkpoint.DAMAGED).exists()


def test_what_is_renamed_is_on_the_disk_before_and_after(tmp_path, monkeypatch):
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
    checkpoint.write_atomically(tmp_path / "a.json", b"{}")
    assert done == ["file", "rename a.json", "folder"]


def damage(path: Path, how: str) -> None:
    content = bytearray(path.read_bytes())
    path.unlink()  # it may be one file under two names
    if how == "a bit":
        length = int.from_bytes(content[:8], "little")
        begin, _ = json.loads(content[8 : 8 + length])["gaussians.means"]["data_offsets"]
        content[8 + length + begin + 100] ^= 4
    elif how == "a digit":
        at = next(m.start() for m in re.finditer(rb"[0-8]", content) if m.start() > content.index(b"extent"))
        content[at] += 1
    elif how == "the end":
        content = content[: len(content) // 2]
    elif how == "zeros":
        content = bytearray(len(content))
    if how != "all of it":
        path.write_bytes(content)


@pytest.mark.parametrize("how", ["a bit", "a digit", "the end", "zeros", "all of it"])
def test_a_damaged_checkpoint(how, tmp_path, at_step, whole, capsys):
    run = tmp_path / "run"
    at_step(HERE, lambda: (_ for _ in ()).throw(MemoryError))
    with pytest.raises(MemoryError):
        fit(often(), tiny_dataset(FRAMES), output=run)
    damage(run / checkpoint.FILE, how)
    with pytest.raises(UserError, match=r"checkpoint.previous.safetensors is there: apps/train.py --resume"):
        Scene.load(run)
    with pytest.raises(UserError, match="holds a run already"):
        fit(config(), tiny_dataset(FRAMES), output=run)
    capsys.readouterr()
    assert go_on(run) == whole
    (said,) = warnings(capsys.readouterr().out)
    assert f"step {HERE - 1}" in said and checkpoint.PREVIOUS in said
    assert (run / checkpoint.DAMAGED).exists() == (how != "all of it")


def test_two_damaged_checkpoints(tmp_path):
    fit(often(), tiny_dataset(FRAMES), output=tmp_path)
    damage(tmp_path / checkpoint.FILE, "a bit")
    damage(tmp_path / checkpoint.PREVIOUS, "the end")
    with pytest.raises(UserError, match="damaged"):
        go_on(tmp_path)
    assert not (tmp_path / checkpoint.DAMAGED).exists(), "nothing is moved for nothing"


# What a run can do without


@pytest.mark.parametrize(("name", "what"), [("log.jsonl", "log lines"), ("latest.png", "previews")])
def test_what_is_for_the_eye_may_fail(name, what, tmp_path, monkeypatch, at_step, whole, capsys):
    monkeypatch.setattr(run_folder, "LOG_EVERY", 5)
    monkeypatch.setattr(run_folder, "PREVIEW_SECONDS", 0.0)
    disk = FakeDisk(monkeypatch, (name,))
    at_step(HERE, lambda: setattr(disk, "full", True))
    at_step(HERE + 12, lambda: setattr(disk, "full", False))
    fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run")
    assert bits(tmp_path / "run") == whole
    (said,) = warnings(capsys.readouterr().out)
    assert what in said and "No space left on device" in said
    steps = [json.loads(line)["step"] for line in (tmp_path / "run/log.jsonl").read_text().split("\n") if line]
    assert steps == ([5, 10, 15, 20, 35, 40] if name == "log.jsonl" else list(range(5, 41, 5)))


def test_event_files_that_fail_are_given_up(tmp_path, monkeypatch, at_step, whole, capfd):
    writer = pytest.importorskip("tensorboard.summary.writer.record_writer").RecordWriter
    monkeypatch.setattr(run_folder, "LOG_EVERY", 2)

    def full(self, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    at_step(HERE, lambda: monkeypatch.setattr(writer, "write", full))
    fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run", tensorboard=True)
    assert bits(tmp_path / "run") == whole
    said = capfd.readouterr()
    assert len(warnings(said.out)) == 1 and "Traceback" not in said.err, said


def test_a_log_that_was_damaged(tmp_path, at_step, whole):
    run = tmp_path / "run"
    at_step(HERE, lambda: os.kill(os.getpid(), signal.SIGTERM))
    with pytest.raises(KeyboardInterrupt):
        fit(config(), tiny_dataset(FRAMES), output=run)
    (run / "log.jsonl").write_bytes(b'\xff\xfe{"step": 1\n[3]\n{"step": "x"}\n{"step": 4, "seconds": 2.5}\n')
    (run / ".checkpoint.safetensors.tmp").write_bytes(b"half")
    assert go_on(run) == whole
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [4, STEPS] and lines[-1]["seconds"] > 2.5
    assert not (run / ".checkpoint.safetensors.tmp").exists()


# Data


def lose(path: Path, how: str) -> None:
    if how == "gone":
        path.unlink()
    elif how == "no picture":
        path.write_bytes(b"not a picture")
    else:
        shutil.copy(path, path.with_suffix(".bak"))
        from PIL import Image

        Image.open(path).resize((30, 30)).save(path)


@pytest.mark.parametrize("how", ["gone", "no picture", "another size"])
def test_an_image_that_is_lost(how, tmp_path, images, at_step):
    path, run = images / "train/train_003.png", tmp_path / "run"
    kept = path.read_bytes()
    fit(config(), load(images), output=tmp_path / "whole")
    at_step(HERE, lambda: lose(path, how))
    line = refused(run, config(), load(images, cache_mib=0))
    assert "train_003" in line and line.endswith("continue with --resume")
    step = checkpoint.read(run)[1]["step"]
    assert step >= HERE and f"step {step} is saved" in line
    path.write_bytes(kept)
    fit(config(), load(images, cache_mib=0), output=run, resume=True)
    assert bits(run) == bits(tmp_path / "whole")


def test_a_held_out_image_that_is_lost(tmp_path, images, at_step, capsys):
    test = load(images, "test", cache_mib=0)
    (images / "test/test_000.png").unlink()
    fit(config(evaluate_every=10), load(images), output=tmp_path / "run", test=test)
    assert len(warnings(capsys.readouterr().out)) == 1
