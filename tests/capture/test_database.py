"""COLMAP's database: interrupted work is resumed, and disk errors are said in one line."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from helpers.films import pan
from helpers.full_disk import small_disk
from scgs_warp.capture import features
from scgs_warp.capture.colmap import opened, remove_database
from scgs_warp.capture.features import FrameFiles
from scgs_warp.errors import UserError
from scgs_warp.storage.png_files import write_png

PAIRS = [(0, 1), (0, 2), (1, 2)]


@pytest.fixture
def frames(tmp_path) -> FrameFiles:
    folder = tmp_path / "frames"
    folder.mkdir()
    names = [f"{index}.png" for index in range(3)]
    for name, picture in zip(names, pan([0, 6, 12], 120, 160)):
        write_png(folder / name, picture)
    return FrameFiles(folder, names, None)


def build(database: Path, frames: FrameFiles) -> list[bytes]:
    """Run or resume both stages; what they wrote."""
    features.begin(database, frames, "SIMPLE_RADIAL", None)
    features.extract(database, frames, 200, lambda: None)
    features.match(database, frames, PAIRS, 0, "cpu", lambda: None)
    with opened(database) as (_, storage):
        images = [storage.read_image_with_name(name).image_id for name in frames.names]
        found = [storage.read_keypoints(image).tobytes() for image in images]
        found += [storage.read_descriptors(image).data.tobytes() for image in images]
        return found + [storage.read_two_view_geometry(images[a], images[b]).inlier_matches.tobytes() for a, b in PAIRS]


def test_an_interrupted_import_begins_anew(tmp_path, frames):
    whole = build(tmp_path / "whole.db", frames)
    features.begin(tmp_path / "cut.db", frames._replace(names=frames.names[:2]), "SIMPLE_RADIAL", None)
    assert build(tmp_path / "cut.db", frames) == whole
    (tmp_path / "bad.db").write_bytes(b"no database" * 500)
    assert build(tmp_path / "bad.db", frames) == whole


@pytest.mark.parametrize("method", ["write_descriptors", "write_keypoints", "write_matches", "write_two_view_geometry"])
def test_work_goes_on_after_any_write(tmp_path, frames, monkeypatch, method):
    import pycolmap

    whole = build(tmp_path / "whole.db", frames)
    inner, left = getattr(pycolmap.Database, method), [2]

    def interrupted(*arguments):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        return inner(*arguments)

    monkeypatch.setattr(pycolmap.Database, method, interrupted)
    with pytest.raises(KeyboardInterrupt):
        build(tmp_path / "cut.db", frames)
    monkeypatch.undo()
    assert build(tmp_path / "cut.db", frames) == whole


def test_finished_features_stay(tmp_path, frames):
    build(tmp_path / "whole.db", frames)
    with opened(tmp_path / "whole.db") as (_, storage):
        storage.update_keypoints(1, np.zeros((4, 4), np.float32))
    features.begin(tmp_path / "whole.db", frames, "SIMPLE_RADIAL", None)
    with opened(tmp_path / "whole.db") as (_, storage):
        assert storage.num_keypoints_for_image(1) == 4


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a forked process")
def test_nothing_remains_of_a_database_whose_writer_was_killed(tmp_path, frames):
    database = tmp_path / "work.db"
    features.begin(database, frames, "SIMPLE_RADIAL", None)
    child = os.fork()
    if child == 0:
        with opened(database) as (_, storage):
            storage.write_keypoints(1, np.zeros((4, 4), np.float32))
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert (tmp_path / "work.db-wal").exists()
    remove_database(database)
    assert not list(tmp_path.glob("work.db*"))


def test_a_database_that_lacks_frames_is_named(tmp_path, frames):
    work = tmp_path / "out/work"
    work.mkdir(parents=True)
    for content in (b"", b"no database" * 500):
        (work / "database.db").write_bytes(content)
        for use in (features.links, lambda *given: features.match(*given, PAIRS, 0, "cpu", lambda: None)):
            with pytest.raises(UserError, match=r"database\.db: is damaged; remove .*out, and capture again"):
                use(work / "database.db", frames)


def test_a_full_disk_is_named_and_work_goes_on(tmp_path, frames):
    whole = build(tmp_path / "whole.db", frames)
    with small_disk(tmp_path / "disk", 2) as disk:
        database = tmp_path / "disk/work.db"
        disk.fill()
        with pytest.raises(UserError, match=r"work\.db: cannot be written.*make room"):
            features.begin(database, frames, "SIMPLE_RADIAL", None)
        disk.free()
        features.begin(database, frames, "SIMPLE_RADIAL", None)
        with pytest.raises(UserError, match=r"work\.db: cannot be written \(database or disk is full\)"):
            features.extract(database, frames, 200, disk.fill)
        disk.free()
        assert build(database, frames) == whole
