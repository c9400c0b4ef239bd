"""The journal of a capture: finished stages are not repeated, other work is left alone."""

from __future__ import annotations

import errno
import json
import os
import shutil

import pytest

from helpers.full_disk import FakeDisk
from scgs_warp.capture.journal import Journal, disk_errors
from scgs_warp.errors import UserError


def start(folder) -> None:
    with Journal(folder, lambda earlier: "film").started():
        pass


def test_the_journal_does_work_once(tmp_path):
    made: list[str] = []

    def run(folder, source="film", **settings):
        journal = Journal(folder, lambda earlier: source)
        with journal.started():
            for name in ("a", "b"):
                value = settings.get(name, 0)
                journal.stage(name, value, lambda n=name, v=value: made.append(f"{n}{v}") or {"v": v}, lambda: None)
        return journal

    run(tmp_path / "x")
    run(tmp_path / "x")
    assert made == ["a0", "b0"]
    run(tmp_path / "x", b=1)
    assert made[2:] == ["b1"]
    assert run(tmp_path / "x", a=1, b=1).result("a") == {"v": 1} and made[3:] == ["a1", "b1"]
    with pytest.raises(UserError, match="another video"):
        run(tmp_path / "x", "other")
    (tmp_path / "x/transforms.json").write_text("{}")
    run(tmp_path / "x", a=1, b=1)
    with pytest.raises(UserError, match="finished"):
        run(tmp_path / "x", a=2, b=1)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/letter.txt").write_text("dear")
    with pytest.raises(UserError, match="something else"):
        run(tmp_path / "mine")
    assert json.loads((tmp_path / "x/work/journal.json").read_text())["stages"]["a"]["result"] == {"v": 1}


def test_an_attempt_that_ended_before_its_first_entry_is_no_obstacle(tmp_path, monkeypatch):
    disk = FakeDisk(monkeypatch, ("journal.json",))
    disk.full = True
    with pytest.raises(UserError, match=r"journal\.json: cannot be written \(No space left on device\)"):
        start(tmp_path / "out")
    assert (tmp_path / "out/work").is_dir()
    disk.full = False
    (tmp_path / "out/work/.journal.json.0a1b2c3d.tmp").write_bytes(b"")
    start(tmp_path / "out")
    assert [path.name for path in (tmp_path / "out/work").iterdir() if path.name != ".lock"] == ["journal.json"]
    start(tmp_path / "out")
    for name in ("letter.txt", "work/letter.txt"):
        (tmp_path / f"{name[0]}/work").mkdir(parents=True)
        (tmp_path / name[0] / name).write_text("dear")
        with pytest.raises(UserError, match="something else"):
            start(tmp_path / name[0])


def test_files_of_systems_are_no_obstacle(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/.DS_Store").write_bytes(b"x")
    start(tmp_path / "out")
    assert (tmp_path / "out/work/journal.json").is_file() and (tmp_path / "out/.DS_Store").read_bytes() == b"x"


def test_a_finished_folder_whose_work_was_deleted_is_called_finished(tmp_path):
    start(tmp_path / "out")
    (tmp_path / "out/transforms.json").write_text("{}")
    shutil.rmtree(tmp_path / "out/work")
    with pytest.raises(UserError, match=r"out: exists and holds a finished data set; give another --output"):
        start(tmp_path / "out")


def test_a_file_that_is_too_large_for_the_disk_is_said(tmp_path):
    with pytest.raises(UserError, match=r"out: cannot be written \(File too large\)"), disk_errors(tmp_path / "out"):
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))


def test_two_captures_do_not_share_a_folder(tmp_path):
    one, two = (Journal(tmp_path / "out", lambda earlier: "film") for _ in range(2))
    with one.started():
        with pytest.raises(UserError, match="out: another capture is running here; wait for it"), two.started():
            pass
        one.stage("a", 0, lambda: 1, dict)
    with two.started():
        assert two.stage("a", 0, lambda: 2, dict) == 1, "what the other has done meanwhile counts"


def test_work_of_earlier_versions_goes_on(tmp_path):
    """They identified a source by another digest."""
    old = Journal(tmp_path / "out", lambda earlier: "old")
    with old.started():
        old.stage("a", 0, lambda: 1, dict)
    new = Journal(tmp_path / "out", lambda earlier: "old" if earlier else "new")
    with new.started():
        assert new.earlier and new.stage("a", 0, lambda: 2, dict) == 1
    assert not Journal(tmp_path / "other", lambda earlier: "old" if earlier else "new").earlier
