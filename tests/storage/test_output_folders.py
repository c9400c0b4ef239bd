"""Output folders: found writable before the work, replaced as a whole after it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from scgs_warp.errors import UserError
from scgs_warp.storage.output_folders import (
    holds_only,
    make_parent,
    paths_in,
    refuse_inputs,
    replace_folder,
    write_folder_atomically,
)


def filled(folder: Path, text: str) -> Path:
    folder.mkdir()
    (folder / "0001.png").write_text(text)
    return folder


def test_parent_is_made(tmp_path: Path):
    make_parent(tmp_path / "a/b/film.mp4")
    assert (tmp_path / "a/b").is_dir()


def test_parent_that_cannot_be_made_is_refused(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"file: cannot be written .*; give another output folder"):
        make_parent(tmp_path / "file/film.mp4")


def test_holds_only_matches_whole_names(tmp_path: Path):
    folder = filled(tmp_path / "frames", "old")
    assert holds_only(folder, r"\d{4}\.png")
    (folder / "0001.png.bak").touch()
    assert not holds_only(folder, r"\d{4}\.png")


def test_what_file_managers_leave_is_no_content(tmp_path: Path):
    for name in ("0001.png", ".DS_Store", "._0001.png", "Thumbs.db"):
        (tmp_path / name).touch()
    assert paths_in(tmp_path) == [tmp_path / "0001.png"] and holds_only(tmp_path, r"\d+\.png")


def test_what_is_read_or_makes_a_run_is_not_written_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name in ("points.csv", "config.json", "metrics.json"):
        (tmp_path / name).touch()
    (tmp_path / "link").symlink_to("points.csv")
    monkeypatch.chdir(tmp_path)
    for name in ("points.csv", "link", "../" + tmp_path.name + "/points.csv"):
        with pytest.raises(UserError, match=rf"--output {name}: would be overwritten, and it is read; give another"):
            refuse_inputs(Path(name), [None, tmp_path / "points.csv"])
    with pytest.raises(UserError, match=r"--json config.json: would be overwritten, and the run needs it"):
        refuse_inputs(Path("config.json"), [], tmp_path, "--json")
    for name in ("metrics.json", "new.csv", "skeleton.json"):  # results can be made again; others do not exist
        refuse_inputs(Path(name), [tmp_path / "points.csv", tmp_path / "missing.json"], tmp_path)


@pytest.mark.parametrize("exists", [False, True])
def test_folder_is_replaced(tmp_path: Path, exists: bool):
    if exists:
        filled(tmp_path / "frames", "old")
    replace_folder(tmp_path / "frames", filled(tmp_path / "new", "new"))
    assert (tmp_path / "frames/0001.png").read_text() == "new"
    assert [entry.name for entry in tmp_path.iterdir()] == ["frames"]


def test_earlier_folder_stays_where_replacing_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    old, new, replace = filled(tmp_path / "frames", "old"), filled(tmp_path / "new", "new"), os.replace

    def fail_for_new(source: Path, target: Path) -> None:
        if source == new:
            raise OSError("no")
        replace(source, target)

    monkeypatch.setattr(os, "replace", fail_for_new)
    with pytest.raises(OSError, match="no"):
        replace_folder(old, new)
    assert (old / "0001.png").read_text() == "old"


def writer(text: str):
    return lambda work: (work / "a.txt").write_text(text)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_folder_that_a_link_leads_to_is_written(tmp_path):
    (tmp_path / "disk").mkdir()
    for target in ("real", "missing"):
        (tmp_path / target).symlink_to(tmp_path / "disk" / target)
    (tmp_path / "disk" / "real").mkdir()
    for link in ("real", "missing"):
        for text in ("first", "second"):
            write_folder_atomically(tmp_path / link, writer(text))
            assert (tmp_path / link).is_symlink() and (tmp_path / "disk" / link / "a.txt").read_text() == text
    assert names(tmp_path / "disk") == ["missing", "real"] and names(tmp_path) == ["disk", "missing", "real"]


@pytest.mark.parametrize("name", [".", "..", "../below"])
def test_the_current_folder_is_not_replaced(name, tmp_path, monkeypatch):
    (tmp_path / "below").mkdir()
    monkeypatch.chdir(tmp_path / "below")
    with pytest.raises(UserError, match="current folder or contains it; name a new folder"):
        write_folder_atomically(Path(name), writer("x"))
    assert names(tmp_path) == ["below"] and names(tmp_path / "below") == []


def test_a_writer_that_fails_leaves_what_was_there(tmp_path):
    write_folder_atomically(tmp_path / "out", writer("first"))

    def fail(work: Path) -> None:
        (work / "a.txt").write_text("half")
        raise OSError(28, "No space left on device")

    with pytest.raises(UserError, match="No space left"):
        write_folder_atomically(tmp_path / "out", fail)
    assert (tmp_path / "out" / "a.txt").read_text() == "first" and names(tmp_path) == ["out"]
