"""Sequences of .ply files: complete or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from helpers.edit_scenes import bar_scene
from scgs_warp.errors import UserError
from scgs_warp.export.moments import at_rest
from scgs_warp.export.sequence import write_sequence
from scgs_warp.types import Gaussians


def frames(count: int) -> list[Gaussians]:
    return [at_rest(bar_scene(nodes=4, gaussians=5)) for _ in range(count)]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_an_earlier_sequence_outlives_a_failed_one(tmp_path, monkeypatch):
    folder = tmp_path / "frames"
    write_sequence(folder, frames(2))
    plain, calls = os.replace, []

    def refuse(source: Path, target: Path) -> None:
        if Path(source).parent == tmp_path and Path(source).suffix == ".tmp":
            calls.append(source)
            raise OSError(5, "Input/output error")
        plain(source, target)

    monkeypatch.setattr("os.replace", refuse)
    with pytest.raises(UserError, match=r"frames: cannot be written \(Input/output error\)"):
        write_sequence(folder, frames(3))
    assert calls and names(folder) == ["frame_00000.ply", "frame_00001.ply"]
    assert names(tmp_path) == ["frames"]


def test_sequences_follow_links_and_leave_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    for count in (3, 2):
        write_sequence(tmp_path / "link", frames(count))
        assert (tmp_path / "link").is_symlink() and len(names(tmp_path / "real")) == count
    (tmp_path / "here" / "below").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here" / "below")
    for name in (".", "..", str(tmp_path / "here" / "below"), "/"):
        with pytest.raises(UserError, match=r"current folder .*; name a new folder"):
            write_sequence(Path(name), frames(1))
    assert names(tmp_path) == ["here", "link", "real"]
