"""Rigs with one folder per camera: the folder names the camera, and holds its only video."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from scgs_warp.capture import RigRequest, capture_rig
from scgs_warp.capture.rig.request import videos_of
from scgs_warp.data.synthetic.films.encoding import write_film
from scgs_warp.errors import UserError


@contextmanager
def silent(total: int, text: str):
    yield SimpleNamespace(advance=lambda count=1: None)


def files(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")
    return folder


def test_the_folder_of_a_video_is_its_camera(tmp_path):
    """All cameras of one make number their videos alike."""
    names = ("cam10/GX010001.MP4", "cam2/GX010001.MP4", "cam1/GX010001.MP4", "cam1/GX010001.THM", "cam1/._GX010001.MP4")
    rig = files(tmp_path / "rig", *names, "notes/plan.txt", ".trash/old.mp4")
    assert videos_of(rig) == {name: rig / name / "GX010001.MP4" for name in ("cam1", "cam2", "cam10")}


def test_films_beside_each_other_are_cameras_whatever_folders_hold(tmp_path):
    rig = files(tmp_path / "rig", "a.mp4", "b.mp4", "originals/a.mov", "cuts/b.mov")
    assert list(videos_of(rig)) == ["a", "b"]


def test_what_cannot_be_told_apart_is_refused(tmp_path):
    for name, content, words in (
        ("parts", ("c1/a.mp4", "c2/a.mp4", "c2/b.mp4"), r"folder c2 holds 2 videos \(a\.mp4, b\.mp4\); leave one"),
        ("loose", ("a.mp4", "c1/a.mp4", "c2/a.mp4"), r"holds a\.mp4 beside folders of videos \(c1, c2\)"),
        ("below", ("all/a.mp4", "all/b.mp4"), r"holds 0 videos, but all does; give --rig .*all"),
        ("one", ("c1/a.mp4",), "holds 1 videos .* or one folder per camera with its video"),
        ("images", ("c1/0.png", "c2/0.png"), r"folders of images \(c1 to c2\); make a video of each"),
    ):
        with pytest.raises(UserError, match=words):
            videos_of(files(tmp_path / name, *content))


def test_their_frames_are_unpacked_by_camera(tmp_path):
    rig, out = tmp_path / "rig", tmp_path / "out"
    for camera, gray in (("left", 60), ("right", 180)):
        (rig / camera).mkdir(parents=True)
        write_film(rig / camera / "film.mp4", [np.full((64, 96, 3), gray, np.uint8)] * 10, 10.0, 20, None)
    with pytest.raises(UserError, match=r"left.film\.mp4, right.film\.mp4: no sound .*--offsets 0"):
        capture_rig(RigRequest(rig), out, show=silent)
    with pytest.raises(UserError, match="no two cameras see enough in common"):
        capture_rig(RigRequest(rig, offsets=(0.0,)), out, show=silent)
    written = {file.name for file in (out / "work/frames").iterdir()}
    assert written == {f"{camera}_{instant:05d}.png" for camera in ("left", "right") for instant in range(10)}
