"""Damaged checkpoints, logs and images: a run falls back on its previous checkpoint or names the file, and resumes to
the same bits (docs/trust.md)."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
from pathlib import Path

import pytest

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
from helpers.tiny import tiny_dataset
from scgs_warp.data import load
from scgs_warp.errors import UserError
from scgs_warp.scene.scene import Scene
from scgs_warp.storage import checkpoint
from scgs_warp.training.loop import fit
from scgs_warp.training.preflight import refuse_early

at_step, done, images, whole = fault_runs.at_step, fault_runs.done, fault_runs.images, fault_runs.whole


def test_checkpoint_with_a_read_error_stays_in_place(tmp_path, monkeypatch):
    fit(every_step(), tiny_dataset(FRAMES), output=tmp_path)
    before = checkpoint_bytes(tmp_path)

    def stale(*_, **__):
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "safe_open", stale)
        with pytest.raises(UserError, match="cannot be read"):
            resume(tmp_path)
    assert checkpoint_bytes(tmp_path) == before and not (tmp_path / checkpoint.DAMAGED).exists()


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
def test_damaged_checkpoint_falls_back_on_the_previous_one(how, tmp_path, at_step, whole, capsys):
    run = tmp_path / "run"
    at_step(FAULT_STEP, lambda: (_ for _ in ()).throw(MemoryError))
    with pytest.raises(MemoryError):
        fit(every_step(), tiny_dataset(FRAMES), output=run)
    damage(run / checkpoint.FILE, how)
    with pytest.raises(UserError, match=r"checkpoint.previous.safetensors is there: apps/train.py --resume"):
        Scene.load(run)
    with pytest.raises(UserError, match="holds a run already"):
        fit(config(), tiny_dataset(FRAMES), output=run)
    capsys.readouterr()
    assert resume(run) == whole
    (said,) = warnings(capsys.readouterr().out)
    assert f"step {FAULT_STEP - 1}" in said and checkpoint.PREVIOUS in said
    assert (run / checkpoint.DAMAGED).exists() == (how != "all of it")


def test_checkpoint_that_links_to_a_disk_that_is_away_is_not_trained_anew(tmp_path):
    fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run")
    link = tmp_path / "run" / checkpoint.FILE
    link.unlink()
    link.symlink_to(tmp_path / "away")
    with pytest.raises(UserError, match=r"checkpoint.safetensors: is no file, or a link to one that is gone"):
        resume(tmp_path / "run")
    with pytest.raises(UserError, match="holds a run already"):
        fit(config(), tiny_dataset(FRAMES), output=tmp_path / "run")
    assert link.is_symlink()


def test_lost_settings_are_named_where_a_run_is_resumed_without_them(tmp_path):
    fit(config(), tiny_dataset(FRAMES), output=tmp_path)
    refuse_early(config(), tmp_path, True)
    with pytest.raises(UserError, match=r"made with seed = 0, now 1; [^;]*$"):
        refuse_early(config(seed=1), tmp_path, True)
    (tmp_path / "config.json").unlink()
    refuse_early(config(), tmp_path, True)
    with pytest.raises(UserError, match=r"made with seed = 0, now 1;.*config.json, which holds them, is missing"):
        refuse_early(config(seed=1), tmp_path, True)


def test_file_in_the_place_of_a_folder_is_named(tmp_path):
    (tmp_path / "previews").write_bytes(b"")
    assert "previews: cannot be written (File exists)" in refusal(tmp_path, config())


@pytest.mark.skipif(os.name != "posix", reason="names are bytes on POSIX systems")
def test_name_that_is_no_utf8_is_refused_before_training(tmp_path):
    """As of a folder from a system with Latin-1. A checkpoint there could be written but not read."""
    folder = tmp_path / os.fsdecode(b"Caf\xe9")
    with pytest.raises(UserError, match="is no name in UTF-8"):
        refuse_early(config(), folder, False)
    with pytest.raises(UserError, match="is no name in UTF-8"):
        checkpoint.read(folder)


def test_two_damaged_checkpoints_are_refused(tmp_path):
    fit(every_step(), tiny_dataset(FRAMES), output=tmp_path)
    damage(tmp_path / checkpoint.FILE, "a bit")
    damage(tmp_path / checkpoint.PREVIOUS, "the end")
    with pytest.raises(UserError, match="damaged"):
        resume(tmp_path)
    assert not (tmp_path / checkpoint.DAMAGED).exists(), "nothing is moved for nothing"


def test_damaged_log_keeps_its_readable_rows(tmp_path, at_step, whole):
    run = tmp_path / "run"
    at_step(FAULT_STEP, lambda: os.kill(os.getpid(), signal.SIGTERM))
    with pytest.raises(KeyboardInterrupt):
        fit(config(), tiny_dataset(FRAMES), output=run)
    (run / "log.jsonl").write_bytes(b'\xff\xfe{"step": 1\n[3]\n{"step": "x"}\n{"step": 4, "seconds": 2.5}\n')
    (run / ".checkpoint.safetensors.tmp").write_bytes(b"half")
    assert resume(run) == whole
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [4, STEPS] and lines[-1]["seconds"] > 2.5
    assert not (run / ".checkpoint.safetensors.tmp").exists()


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
def test_lost_training_image_ends_the_run_with_a_checkpoint(how, tmp_path, images, at_step):
    path, run = images / "train/train_003.png", tmp_path / "run"
    kept = path.read_bytes()
    fit(config(), load(images), output=tmp_path / "whole")
    at_step(FAULT_STEP, lambda: lose(path, how))
    line = refusal(run, config(), load(images, cache_mib=0))
    assert "train_003" in line and line.endswith("continue with --resume")
    step = checkpoint.read(run)[1]["step"]
    assert step >= FAULT_STEP and f"step {step} is saved" in line
    path.write_bytes(kept)
    fit(config(), load(images, cache_mib=0), output=run, resume=True)
    assert checkpoint_bytes(run) == checkpoint_bytes(tmp_path / "whole")


def test_lost_held_out_image_is_a_warning(tmp_path, images, at_step, capsys):
    test = load(images, "test", cache_mib=0)
    (images / "test/test_000.png").unlink()
    fit(config(evaluate_every=10), load(images), output=tmp_path / "run", test=test)
    assert len(warnings(capsys.readouterr().out)) == 1
