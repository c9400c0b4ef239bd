"""A rig's capture as a whole: films of cameras that begin at different moments become a folder that trains."""

from __future__ import annotations

import json
import re
import shutil
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from helpers.films import encoded, spoil
from helpers.full_disk import FakeDisk
from helpers.rigs import FPS, RigFilms, film_rig, write_poses_bounds
from scgs_warp.apps import capture as app
from scgs_warp.capture import RigRequest, capture_rig, pictures
from scgs_warp.capture.rig import common_size, pipeline
from scgs_warp.capture.rig.neural_video import write_neural_video
from scgs_warp.capture.rig.points import points_at
from scgs_warp.capture.similarity import align, centres
from scgs_warp.capture.source import Video
from scgs_warp.data import load
from scgs_warp.data.synthetic.films.encoding import write_film
from scgs_warp.errors import UserError

LATE = [4, 0, 2, 7, 1, 10]
"""Frames by which the cameras begin late: up to half a second."""
COUNT = 18
DOUBLE = np.ones((2, 2, 1), np.uint8)


@contextmanager
def silent(total: int, text: str):
    """No progress, but it is counted."""
    counted = SimpleNamespace(done=0, total=total)

    def advance(count: int = 1) -> None:
        counted.done += count

    counted.advance = advance
    yield counted
    assert counted.done <= total, text


def run(films: Path, folder: Path, **options):
    return capture_rig(RigRequest(films, **options), folder, show=silent)


@pytest.fixture(scope="module")
def films(tmp_path_factory) -> RigFilms:
    return film_rig(tmp_path_factory.mktemp("rigs") / "rig", LATE, COUNT)


@pytest.fixture(scope="module")
def captured(films, tmp_path_factory) -> Path:
    """Interrupted before the cameras, then finished."""
    folder = tmp_path_factory.mktemp("captures") / "rig"

    def interrupted(*_):
        raise KeyboardInterrupt

    patch = pytest.MonkeyPatch()
    patch.setattr(pipeline.cameras, "solve", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(films.folder, folder)
    patch.undo()
    assert not (folder / "transforms.json").exists()
    made = run(films.folder, folder)
    assert len(made.registered) == 6 and made.held_out == "cam0" and not made.made_before
    assert np.abs(np.array(made.starts) - films.starts).max() < 0.5 / FPS / 5
    return folder


def test_cameras_are_where_they_were(films, captured):
    content = json.loads((captured / "transforms.json").read_text())
    views = {f["camera"]: np.linalg.inv(np.array(f["transform_matrix"]) @ np.diag([1, -1, -1, 1.0]))
             for f in content["frames"]}  # fmt: skip
    found = np.stack([views[f"cam{index}"] for index in range(6)])
    fit = align(centres(found), centres(films.viewmats))
    error = np.linalg.norm(centres(fit.viewmats(found)) - centres(films.viewmats), axis=1)
    assert error.max() < 0.02
    # The centres lie almost on a line, about which they leave the rotation open: compare the cameras with each other.
    turns = [views[1:, :3, :3] @ views[0, :3, :3].T for views in (found, films.viewmats)]
    traces = np.einsum("vij,vij->v", *turns)
    assert np.degrees(np.arccos(((traces - 1) / 2).clip(-1, 1))).max() < 0.5


def test_the_folder_trains_with_one_camera_held_out(films, captured):
    """All cameras are on one time line, and points lie on the figure, too."""
    train, test = load(captured), load(captured, "test")
    common = COUNT - max(LATE)
    assert len(train) == 5 * common and len(test) == common
    assert {frame.name.split("_")[0] for frame in test.entries} == {"cam0"}
    assert sorted(set(test.times.tolist())) == pytest.approx(np.linspace(0, 1, common).tolist(), abs=1e-6)
    counts = torch.unique(train.times, return_counts=True)[1]
    assert counts.tolist() == [5] * common, "frames of one instant share its time"
    assert train.points is not None and train.colors is not None and len(train.points) > 300


def test_frames_are_those_of_the_same_moment(films, captured):
    """Frame 0 of the time line is the first that the latest camera recorded."""
    content = json.loads((captured / "transforms.json").read_text())
    seconds = sorted({round(frame["seconds"], 4) for frame in content["frames"]})
    np.testing.assert_allclose(seconds, np.arange(COUNT - max(LATE)) / FPS, atol=1e-3)


def test_a_finished_capture_is_left_alone(films, captured):
    before = (captured / "transforms.json").stat().st_mtime_ns
    assert run(films.folder, captured).made_before
    with pytest.raises(UserError, match="finished capture, made with other settings"):
        run(films.folder, captured, size=200)
    assert (captured / "transforms.json").stat().st_mtime_ns == before


def test_a_capture_that_an_earlier_version_finished_is_left_alone(films, captured, tmp_path):
    """It has no adjusted cameras."""
    old = tmp_path / "old"
    shutil.copytree(captured, old)
    shutil.rmtree(old / "work/adjusted")
    journal = json.loads((old / "work/journal.json").read_text())
    del journal["stages"]["adjustment"]
    (old / "work/journal.json").write_text(json.dumps(journal))
    assert run(films.folder, old).made_before
    assert not (old / "work/adjusted").exists()


def test_cameras_that_are_not_adjusted_are_named(films, captured, tmp_path):
    assert not any("adjust" in line for line in run(films.folder, captured).lines)
    other = tmp_path / "other"
    shutil.copytree(captured, other)
    journal = json.loads((other / "work/journal.json").read_text())
    assert journal["stages"]["adjustment"]["result"] is True
    journal["stages"]["adjustment"]["result"] = False
    (other / "work/journal.json").write_text(json.dumps(journal))
    assert any(line.startswith("note: ") and "adjust" in line for line in run(films.folder, other).lines)


def test_cameras_that_moved_are_named_with_a_remedy():
    stored = {"shifts": [0.2, 5.0, 7.0], "bumps": [None, [1.239, 1.301], None]}
    rig: Any = SimpleNamespace(names=["a", "b", "c"], journal=SimpleNamespace(result=lambda _: stored))
    bumped, moved = pipeline._Rig.unsteady(rig)
    assert (
        bumped.startswith("note: b was moved between seconds 1.23 and 1.31,") and "--end 1.23 or --start 1.31" in bumped
    )
    assert moved.startswith("note: c moved while recording") and "take its video out" in moved
    del stored["bumps"]  # as in captures of earlier versions
    assert pipeline._Rig.unsteady(rig)[1] == moved


def test_what_is_held_out_of_few_cameras_is_said(films, captured, monkeypatch):
    monkeypatch.setattr(pipeline, "FEW_CAMERAS", 7)
    assert run(films.folder, captured).held_out == "every eighth instant"


def test_a_folder_is_complete_once_all_is_written(films, captured, tmp_path, monkeypatch):
    """A full disk or Ctrl-C at the last file leaves no folder that passes for a finished one."""
    folder = tmp_path / "rig"
    shutil.copytree(captured, folder)
    (folder / "transforms.json").unlink()

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(pictures, "cameras", interrupted)
        run(films.folder, folder)
    assert not (folder / "transforms.json").exists() and not run(films.folder, folder).made_before
    (tmp_path / "poses_bounds.npy").write_bytes(b"poses")
    points = np.zeros((1, 3)), np.zeros((1, 3), np.uint8)
    (tmp_path / "out").mkdir()
    disk = FakeDisk(monkeypatch, ("poses_bounds.npy",))
    disk.full = True
    with pytest.raises((UserError, OSError), match="No space left on device"):
        write_neural_video(tmp_path / "out", tmp_path, [], 0, lambda *_: tmp_path, points, silent)
    assert not (tmp_path / "out/poses_bounds.npy").exists()


def test_cameras_that_are_held_otherwise_or_have_more_pixels_are_used_whole(films, tmp_path, monkeypatch):
    """Pictures of the one are turned, those of the other reduced, instead of cut."""
    monkeypatch.setattr(common_size, "LEAST_SIDE", 100)
    folder = tmp_path / "rig"
    shutil.copytree(films.folder, folder)
    for name, change in (("cam2", lambda image: np.rot90(image, 3)), ("cam4", lambda image: np.kron(image, DOUBLE))):
        pictures = [np.ascontiguousarray(change(still.image)) for still in Video(folder / f"{name}.mp4").frames(1000)]
        write_film(folder / f"{name}.mp4", pictures, FPS, 14, None)
    made = run(folder, tmp_path / "out", offsets=tuple(films.starts.tolist()))
    assert len(made.registered) == 6 and any("cam2 are turned by a quarter" in line for line in made.lines)
    data = load(tmp_path / "out")
    assert min(data[0].image.shape[:2]) > 0.9 * 180 and max(data[0].image.shape[:2]) > 0.9 * 320
    content = json.loads((tmp_path / "out/transforms.json").read_text())
    focals = [frame["fl_x"] for frame in content["frames"]]
    assert max(focals) < 1.1 * min(focals), "none sees less than the others"
    ups = {f["camera"]: np.array(f["transform_matrix"])[:3, 1] for f in content["frames"]}
    assert all(up[2] > 0.8 for name, up in ups.items() if name != "cam2"), "the world is upright"


def test_videos_of_neural_3d_video_are_unpacked(films, tmp_path, capsys):
    """With cameras of their own, all begin at once; the reader loads what comes of it, with points."""
    source = tmp_path / "scene"
    shutil.copytree(films.folder, source)
    write_poses_bounds(films._replace(folder=source), 320, 180)
    with pytest.raises(UserError, match=r"capture\.py --rig"):
        load(source)
    assert app.cli(["--rig", str(source), "--output", str(tmp_path / "images"), "--device", "cpu"]) == 0
    assert "6 of 6 cameras, cam0 held out" in capsys.readouterr().out
    train, test = load(tmp_path / "images"), load(tmp_path / "images", "test")
    assert len(test) == COUNT and len(train) == 5 * COUNT
    np.testing.assert_allclose(test.entries[0].camera.viewmat.numpy(), films.viewmats[0], atol=1e-5)
    assert train.points is not None and len(train.points) > 150
    points = train.points.numpy()
    on_floor_or_above = points[:, 2] > films.floor - 0.15
    assert on_floor_or_above.mean() > 0.95 and (np.abs(points) < 4.6).all(1).mean() > 0.95
    assert run(source, tmp_path / "images").made_before


def test_points_lie_where_the_rays_meet():
    """The same picture in two cameras of a flat wall: exact positions."""
    from scgs_warp.capture.rig.cameras import RigCamera

    rng = np.random.default_rng(0)
    wall = np.kron(rng.integers(0, 255, (45, 80, 3)), np.ones((4, 4, 1))).astype(np.uint8)
    cameras = {}
    for number, x in enumerate((0.0, 0.5)):
        viewmat = np.eye(4)
        viewmat[0, 3] = -x
        cameras[number] = RigCamera("PINHOLE", (300.0, 300.0, 160.0, 90.0), 320, 180, viewmat)
    pictures = {0: wall, 1: np.roll(wall, -60, axis=1)}  # 300 px x 0.5 / 2.5
    points, colors = points_at(pictures, cameras, 1000)
    assert len(points) > 50 and colors.dtype == np.uint8
    assert np.median(np.abs(points[:, 2] - 2.5)) < 0.02


# What cannot work is said in one line


def test_mistakes_are_named(films, tmp_path, capsys):
    folder = str(films.folder)
    for arguments, words in (
        ([], "neither VIDEO nor --rig"),
        ([f"{folder}/cam0.mp4", "--rig", folder], "both VIDEO and --rig"),
        ([f"{folder}/cam0.mp4", "--offsets", "0"], "--offsets: is for --rig"),
        (["--rig", folder, "--offsets", "0", "1"], "2 numbers for 6 videos"),
        (["--rig", folder, "--held-out", "cam9"], "--held-out cam9"),
        (["--rig", folder, "--frames", "2"], "--frames 2"),
        (["--rig", folder, "--keep-static", "off"], "--keep-static: is for one camera"),
        (["--rig", str(tmp_path)], "holds 0 videos"),
        (["--rig", str(tmp_path / "none")], "no such folder"),
    ):
        assert app.cli([*arguments, "--output", str(tmp_path / "out"), "--device", "cpu"]) == 2
        error = capsys.readouterr().err
        assert words in error and error.count("\n") == 1, error
    assert not (tmp_path / "out").exists()


def test_rows_and_videos_must_match(films, tmp_path):
    source = tmp_path / "scene"
    shutil.copytree(films.folder, source)
    write_poses_bounds(films._replace(folder=source, viewmats=films.viewmats[:4]), 320, 180)
    with pytest.raises(UserError, match=r"4 rows, but .* holds 6 videos"):
        run(source, tmp_path / "out")


def test_silent_films_and_blank_films(tmp_path):
    source = tmp_path / "mute"
    source.mkdir()
    for index in range(3):
        write_film(source / f"cam{index}.mp4", [np.full((64, 96, 3), 100, np.uint8)] * 10, 10.0, 20, None)
    with pytest.raises(UserError, match=r"cam0\.mp4.*: no sound .*--offsets 0"):
        run(source, tmp_path / "out")
    with pytest.raises(UserError, match="no two cameras see enough in common"):
        run(source, tmp_path / "blank", offsets=(0.0,))
    assert (tmp_path / "blank/contact_sheet.png").exists()


@pytest.mark.parametrize("kind", ["avi", "mkv"])
def test_frames_of_other_containers_have_their_moments(tmp_path, kind):
    files = [tmp_path / f"films/{name}.{kind}" for name in ("a", "b")]
    files[0].parent.mkdir()
    for file in files:
        encoded(file, 40)
    rig = pipeline._Rig(RigRequest(files[0].parent), tmp_path / "out", {f.stem: f for f in files}, "x", "cpu", silent)
    with rig.journal.started():
        line = rig.frames([0.0, 0.08], known=False)
    np.testing.assert_allclose(line.moments, np.tile(np.arange(38) / 25, (2, 1)), atol=1e-9)
    shown = list(Video(files[1]).frames(1280))
    assert all(np.array_equal(rig.picture(1, instant), shown[instant].image) for instant in range(38))


def test_films_that_are_cut_off_or_damaged(tmp_path):
    """What is left of a film is used, and said; moments are not guessed."""
    source = tmp_path / "films"
    source.mkdir()
    for name in ("a", "b"):
        encoded(source / f"{name}.mp4", 100, {"movflags": "faststart"})
    content = (source / "a.mp4").read_bytes()
    (source / "a.mp4").write_bytes(content[: 6 * len(content) // 10])
    videos = {"a": source / "a.mp4", "b": source / "b.mp4"}
    rig = pipeline._Rig(RigRequest(source), tmp_path / "out", videos, "x", "cpu", silent)
    with rig.journal.started():
        line = rig.frames([0.0, 0.0], known=False)
    assert 1.0 < line.seconds[-1] < 3.5 and len(rig.cut_off()) == 1
    assert re.search(r"a\.mp4: \d\d of 100 frames can be decoded, until second", rig.cut_off()[0])
    spoil(source / "b.mp4", 0.25, 0.1)
    with pytest.raises(UserError, match=r"b\.mp4: frames before second \d\.\d\d cannot be decoded"):
        run(source, tmp_path / "spoilt", offsets=(0.0,))
