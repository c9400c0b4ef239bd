"""Folders that are written as a whole: links, the current folder, and writers that fail."""

from __future__ import annotations

from pathlib import Path

import pytest

from scgs_warp.data.synthetic.renderer import write_folder_atomically
from scgs_warp.errors import UserError


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
