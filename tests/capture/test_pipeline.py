"""Capture as a whole: a film of a furnished room, in which something moves, becomes a folder that trains."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("pygltflib")

from helpers.films import cut_copy
from helpers.full_disk import small_disk
from helpers.paths import ROOT
from helpers.room import Film, path_length, save, shoot
from scgs_warp.capture import CaptureRequest, as_shown, capture, mapping, picked_frames, picking, pipeline, source
from scgs_warp.capture.journal import Journal
from scgs_warp.capture.similarity import align, centres
from scgs_warp.capture.source import open_source
from scgs_warp.data import load
from scgs_warp.errors import UserError
from scgs_warp.storage.png_files import write_png
from scgs_warp.visualization.video import film as film_writer

FRAMES = 22


@contextmanager
def silent(total: int, text: str):
    """No progress, but it is counted."""
    counted = SimpleNamespace(done=0, total=total)

    def advance(count: int = 1) -> None:
        counted.done += count

    counted.advance = advance
    yield counted
    assert counted.done <= total, text


def run(source: Path, folder: Path, **options):
    return capture(CaptureRequest(source, **options), folder, show=silent)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> tuple[Film, Path]:
    made = shoot(FRAMES, 320, 240)
    return made, save(made, tmp_path_factory.mktemp("film") / "room.mp4", fps=10)


OPTIONS = {"features": 1500, "matching": "sequential"}


@pytest.fixture(scope="module")
def captured(filmed, tmp_path_factory) -> Path:
    """Interrupted before the cameras, then finished."""
    folder = tmp_path_factory.mktemp("captures") / "room"

    def interrupted(*_):
        raise KeyboardInterrupt

    patch = pytest.MonkeyPatch()
    patch.setattr(pipeline.mapping, "solve", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(filmed[1], folder, **OPTIONS)
    patch.undo()
    assert not (folder / "transforms.json").exists()
    before = {file: file.stat().st_mtime_ns for file in (folder / "work/frames").iterdir()}
    made = run(filmed[1], folder, **OPTIONS)
    assert not made.made_before and made.outcome.registered == made.outcome.picked == FRAMES
    assert before == {file: file.stat().st_mtime_ns for file in (folder / "work/frames").iterdir()}, "made once"
    return folder


def read(folder: Path) -> tuple[np.ndarray, list[int], dict]:
    """World-to-camera matrices [V, 4, 4] as our reader gives them, numbers of the frames, transforms.json."""
    entries = [entry for split in ("train", "test") for entry in load(folder, split).entries]
    entries.sort(key=lambda entry: entry.name)
    views = torch.stack([entry.camera.viewmat for entry in entries]).double().numpy()
    numbers = [int(entry.name.split("_")[1]) for entry in entries]
    return views, numbers, json.loads((folder / "transforms.json").read_text())


def check_cameras(truth: Film, folder: Path) -> None:
    views, numbers, _ = read(folder)
    assert len(numbers) >= 0.9 * len(truth.frames)
    found, expected = centres(views), truth.centres[numbers]
    error = np.linalg.norm(align(found, expected).points(found) - expected, axis=1)
    assert error.max() < 0.01 * path_length(truth.centres), error


def test_cameras_are_where_they_were(filmed, captured):
    truth, _ = filmed
    check_cameras(truth, captured)
    views, numbers, _ = read(captured)
    turned = align(centres(views), truth.centres[numbers]).viewmats(views)
    traces = np.einsum("vij,vij->v", turned[:, :3, :3], truth.viewmats[numbers, :3, :3])
    assert np.degrees(np.arccos(((traces - 1) / 2).clip(-1, 1))).max() < 1.0
    camera = load(captured)[0].camera
    assert float(camera.K[0, 0]) == pytest.approx(0.85 * 320, rel=0.02)


def test_the_folder_trains(captured):
    """Times are those of the film, no frame is both trained on and held out, points have colours."""
    content = read(captured)[2]
    train, test = load(captured), load(captured, "test")
    assert len(train) + len(test) == FRAMES and not {f.name for f in train} & {f.name for f in test}
    times = {frame["file_path"]: frame["time"] for frame in content["frames"]}
    np.testing.assert_allclose(sorted(times.values()), np.arange(FRAMES) / (FRAMES - 1), atol=1e-6)
    np.testing.assert_allclose([frame["seconds"] for frame in content["frames"]], np.arange(FRAMES) / 10, atol=1e-3)
    assert train.points is not None and len(train.points) > 500 and train.colors is not None
    masked = [file.name for file in (captured / "masks").iterdir()]
    assert sorted(masked) == sorted(file.name for file in (captured / "images").iterdir())
    for name in ("contact_sheet.png", "cameras.png"):
        assert (captured / name).stat().st_size > 10_000


def test_a_finished_capture_is_left_alone(filmed, captured, tmp_path):
    files = {file: file.stat().st_mtime_ns for file in captured.rglob("*.[pj]*") if file.name != "journal.json"}
    assert run(filmed[1], captured, **OPTIONS).made_before
    with pytest.raises(UserError, match="finished capture, made with other settings"):
        run(filmed[1], captured, size=200, **OPTIONS)
    assert files == {file: file.stat().st_mtime_ns for file in files}


def test_a_capture_that_an_earlier_version_finished_is_left_alone(filmed, captured, tmp_path):
    """Such a journal does not say whether the film is complete."""
    folder = tmp_path / "room"
    shutil.copytree(captured, folder)
    journal = json.loads((folder / "work/journal.json").read_text())
    for name in ("decoded", "announced"):
        assert journal["stages"]["frames"]["result"].pop(name) == 0
    (folder / "work/journal.json").write_text(json.dumps(journal))
    made = run(filmed[1], folder, **OPTIONS)
    assert made.made_before and len(made.lines) == 1


def test_the_background_alone(filmed, captured, tmp_path):
    """Frames name the masks of what moves, cameras and points stay; the folder keeps to its settings."""
    folder = tmp_path / "room"
    shutil.copytree(captured, folder)
    (folder / "transforms.json").unlink()
    assert not run(filmed[1], folder, keep="static", **OPTIONS).made_before
    (one, _, whole), (two, _, background) = read(captured), read(folder)
    np.testing.assert_array_equal(one, two)
    assert (folder / "points.ply").read_bytes() == (captured / "points.ply").read_bytes()
    assert not any("mask_path" in frame for frame in whole["frames"])
    ignored = [float((~frame.mask).float().mean()) for frame in load(folder) if frame.mask is not None]
    assert len(ignored) == len(load(folder)) and 0.005 < np.mean(ignored) < 0.3 and not load(folder).with_alpha
    assert all(frame["mask_path"] == frame["file_path"].replace("images", "masks") for frame in background["frames"])
    assert run(filmed[1], folder, keep="static", **OPTIONS).made_before
    for finished, keep in ((folder, "all"), (captured, "static")):
        with pytest.raises(UserError, match=r"made with other settings \(images\)"):
            run(filmed[1], finished, keep=keep, **OPTIONS)


def write_masks(folder: Path, masks) -> Path:
    folder.mkdir()
    for index, moving in enumerate(masks):
        write_png(folder / f"{index:03d}.png", np.repeat(np.where(moving, 0, 255).astype(np.uint8)[..., None], 3, 2))
    return folder


def test_the_mover_alone(filmed, captured, tmp_path):
    """Alpha shows the box that moves, and nothing else; its world is that of the background."""
    truth, film = filmed
    given = write_masks(tmp_path / "given", truth.moving)
    run(film, tmp_path / "mover", masks=str(given), keep="moving", **OPTIONS)
    check_cameras(truth, tmp_path / "mover")
    data = load(tmp_path / "mover")
    assert data.with_alpha and data.points is None
    shared = []
    for frame in data:
        alpha = frame.alpha.numpy()
        moving = truth.moving[int(frame.name.split("_")[1])].astype(np.uint8)
        moving = cv2.resize(moving, alpha.shape[::-1], interpolation=cv2.INTER_NEAREST).astype(bool)
        shared.append((moving & (alpha > 0.5)).sum() / max((moving | (alpha > 0.5)).sum(), 1))
        picture = cv2.imread(str(tmp_path / f"mover/images/{frame.name}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_allclose(picture[..., 2::-1] / 255 * alpha[..., None], frame.image.numpy(), atol=0.01)
    assert np.mean(shared) > 0.9
    white = write_masks(tmp_path / "white", [np.zeros_like(moving) for moving in truth.moving])
    with pytest.raises(UserError, match="no pixel is black"):
        run(film, tmp_path / "nothing", masks=str(white), keep="moving", **OPTIONS)


def test_images_that_are_cut_out_stay_so(filmed, tmp_path):
    """What alpha hides is no part of the scene: here, a pattern that goes along with the camera."""
    truth, _ = filmed
    (tmp_path / "images").mkdir()
    fixed = noise(0)[:120, :160].repeat(2, 0).repeat(2, 1)
    alpha = np.full((240, 320, 1), 255, np.uint8)
    alpha[:, :140] = 0
    for index, frame in enumerate(truth.frames):
        shown = np.where(alpha > 0, frame, fixed)
        write_png(tmp_path / f"images/{index:03d}.png", np.dstack([shown, alpha]))
    made = run(tmp_path / "images", tmp_path / "out", **OPTIONS)
    assert any("cut out by alpha" in line for line in made.lines)
    check_cameras(truth, tmp_path / "out")
    data = load(tmp_path / "out")
    assert data.with_alpha and data.points is not None and len(data.points) > 200
    for frame in data:
        assert not frame.alpha[:, :100].any() and frame.alpha[:, -100:].all()
        assert not frame.image[:, :100].any(), "no colour of what is hidden"


def test_black_bars_are_cut_off(filmed, tmp_path):
    """Cameras are those of the film without them, and given masks are cut likewise."""
    truth, _ = filmed
    film = write_film(tmp_path / "bars.mp4", [np.pad(frame, ((40, 40), (0, 0), (0, 0))) for frame in truth.frames])
    given = write_masks(tmp_path / "given", [np.pad(moving, ((40, 40), (0, 0))) for moving in truth.moving])
    made = run(film, tmp_path / "out", masks=str(given), **OPTIONS)
    assert any("black bars" in line for line in made.lines)
    check_cameras(truth, tmp_path / "out")
    data = load(tmp_path / "out")
    assert data[0].image.shape[0] <= 240 and all(frame.mask is None for frame in data)
    assert min(float(frame.image[[0, -1]].mean()) for frame in data) > 0.1
    made = run(film, tmp_path / "out", masks=str(given), **OPTIONS)
    assert made.made_before and any("black bars" in line for line in made.lines)


def test_the_same_film_gives_the_same_bytes(filmed, captured, tmp_path):
    """Matching and mapping once more, in a copy."""
    again = tmp_path / "again"
    shutil.copytree(captured / "work", again / "work")
    journal = json.loads((again / "work/journal.json").read_text())
    for name in ("matches", "cameras", "adjustment"):
        journal["stages"].pop(name)
    (again / "work/journal.json").write_text(json.dumps(journal))
    run(filmed[1], again, **OPTIONS)
    for name in ("transforms.json", "points.ply"):
        assert (again / name).read_bytes() == (captured / name).read_bytes(), name


# What cannot work is said in one line; what was made is kept


def write_film(path: Path, frames) -> Path:
    with film_writer(path, 10) as out:
        for frame in frames:
            out.write(frame)
    return path


def noise(seed: int) -> np.ndarray:
    """A picture that has nothing in common with that of another seed."""
    rng = np.random.default_rng(seed)
    return np.kron(rng.integers(0, 256, (20, 27, 3), np.uint8), np.ones((6, 6, 1), np.uint8))


def test_a_film_that_was_cut_off_is_said_to_be(tmp_path, filmed):
    """With each result, also where the frames were picked before; not if an earlier --end was given."""
    cut, out = tmp_path / "cut.mp4", tmp_path / "out"
    cut_copy(filmed[1], cut, 0.64)
    made = [run(cut, out, masks="none", **OPTIONS) for _ in range(2)]
    assert [len(each.lines) for each in made] == [2, 2] and made[0].lines == made[1].lines
    assert re.match(rf"note: .*cut\.mp4: 1\d of {FRAMES} frames can be decoded, until second 1\.", made[0].lines[1])
    assert picked_frames.choose(CaptureRequest(cut, end=0.6), open_source(cut), silent).incomplete is None
    cut_copy(filmed[1], cut, 0.3)
    with pytest.raises(UserError, match=rf"cut\.mp4: only \d of {FRAMES} frames can be decoded"):
        run(cut, tmp_path / "few")


def test_frames_that_are_not_picked_are_converted_once(tmp_path, filmed, monkeypatch):
    """Most of a long film in 4K is only looked at, reduced; at full size, converting it takes minutes."""
    sizes: list[int] = []

    def picture(frame, longest: int, shape: float):
        sizes.append(longest)
        return as_shown.picture(frame, longest, shape)

    monkeypatch.setattr(source, "picture", picture)
    request, journal = CaptureRequest(filmed[1], frames=8), Journal(tmp_path, lambda earlier: "")
    with journal.started():
        made = picked_frames.pick_frames(request, open_source(filmed[1]), journal, silent)
    assert sizes == FRAMES * [picking.SHARPNESS_SIDE] + len(made.indices) * [request.size]


def test_images_that_have_nothing_in_common(tmp_path):
    (tmp_path / "images").mkdir()
    for index in range(7):
        write_png(tmp_path / f"images/{index}.png", noise(index))
    with pytest.raises(UserError, match=r"0 of 7 frames registered; .*little in common.*kept") as error:
        run(tmp_path / "images", tmp_path / "out", masks="none", features=300)
    assert "\n" not in str(error.value) and "--frames" not in str(error.value), "all frames are taken"
    assert (tmp_path / "out/contact_sheet.png").is_file() and len(list((tmp_path / "out/work/frames").iterdir())) == 7
    assert not (tmp_path / "out/transforms.json").exists()


@pytest.mark.parametrize("option", ["start", "end"])
def test_images_have_no_seconds_to_choose_from(tmp_path, option):
    """The options were taken, and all images used."""
    write_png(tmp_path / "1.png", noise(0))
    with pytest.raises(UserError, match=f"--{option}: is for a video, but .* is a folder"):
        run(tmp_path, tmp_path / "out", **{option: 2.0})
    assert not (tmp_path / "out").exists()


def test_a_full_disk_is_said_and_work_goes_on(tmp_path):
    (tmp_path / "images").mkdir()
    for index in range(7):
        picture = np.random.default_rng(index).integers(0, 256, (120, 160, 3), np.uint8)
        write_png(tmp_path / f"images/{index}.png", picture)
    with small_disk(tmp_path / "disk", 4) as disk:
        (tmp_path / "disk/ballast").write_bytes(bytes(4_000_000))
        with pytest.raises(UserError, match=r"out: cannot be written \(No space left on device\); make room"):
            run(tmp_path / "images", tmp_path / "disk/out", masks="none", features=64)
        disk.free()
        with pytest.raises(UserError, match="0 of 7 frames registered"):
            run(tmp_path / "images", tmp_path / "disk/out", masks="none", features=64)


def test_a_camera_that_stands_still(tmp_path, filmed):
    frames = []
    for index in range(10):
        frames.append(filmed[0].frames[0].copy())
        frames[-1][60:180, 25 * index : 25 * index + 80] = noise(0)[:120, :80]
    film = write_film(tmp_path / "tripod.mp4", frames)
    with pytest.raises(UserError, match=r"the camera stands still, .* film from several places"):
        run(film, tmp_path / "out", features=800)


def test_a_film_without_texture(tmp_path):
    bare = shoot(8, 160, 120, samples=1, contrast=0.0)
    (tmp_path / "images").mkdir()
    for index, frame in enumerate(bare.frames):
        write_png(tmp_path / f"images/{index}.png", frame)
    with pytest.raises(UserError, match="texture"):
        run(tmp_path / "images", tmp_path / "out")


def test_a_film_that_is_too_short_or_rests(tmp_path, filmed):
    with pytest.raises(UserError, match=r"three\.mp4: 3 frames are too few"):
        run(write_film(tmp_path / "three.mp4", filmed[0].frames[:3]), tmp_path / "a")
    write_png(tmp_path / "one.png", filmed[0].frames[0])
    with pytest.raises(UserError, match=r"one\.png: is a single picture; give a film, or a folder of images"):
        run(tmp_path / "one.png", tmp_path / "one")
    with pytest.raises(UserError, match=r"1 of 12 frames are neither blurred nor alike.*11 alike"):
        run(write_film(tmp_path / "rest.mp4", [filmed[0].frames[0]] * 12), tmp_path / "b")
    with pytest.raises(UserError, match=r"--start 99"):
        run(filmed[1], tmp_path / "c", start=99)


@pytest.mark.parametrize(
    ("options", "named"),
    [({"frames": 2}, "--frames 2"), ({"size": 4}, "--size 4"), ({"fov": 500.0}, "--fov 500"),
     ({"least": 2.0}, "--least"), ({"features": 1}, "--features"), ({"seed": -1}, "--seed"),
     ({"start": 3.0, "end": 2.0}, "--start 3 --end 2"), ({"keep": "moving"}, "--keep-static off: needs masks"),
     ({"masks": "nowhere"}, "--masks nowhere: no such file or folder; give auto, none, or masks"),
     ({"keep": "static", "masks": "none"}, "--keep-moving off: needs masks")],
)  # fmt: skip
def test_options_that_cannot_work(tmp_path, options, named):
    with pytest.raises(UserError, match=named):
        run(tmp_path / "film.mp4", tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_the_app_says_it_in_one_line(tmp_path, captured, filmed):
    def app(*arguments: str) -> subprocess.CompletedProcess:
        command = [sys.executable, str(ROOT / "apps/capture.py"), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=300)

    (tmp_path / "film.mp4").write_bytes(b"no film")
    done = app(str(tmp_path / "film.mp4"), "--output", str(tmp_path / "out"))
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1 and "film.mp4" in done.stderr
    assert not (tmp_path / "out").exists()
    done = app("film.mp4", "--output", str(tmp_path / "out"), "--keep-static", "off", "--keep-moving", "off")
    assert done.returncode == 2 and "nothing is left" in done.stderr and len(done.stderr.strip().splitlines()) == 1
    done = app(str(filmed[1]), "--output", str(captured), "--features", "1500", "--matching", "sequential")
    assert done.returncode == 0 and f"{FRAMES} of {FRAMES} frames have a camera" in done.stdout, done.stderr


@pytest.mark.slow
def test_the_acceptance_film(tmp_path):
    made = shoot(240, 640, 480)
    run(save(made, tmp_path / "room.mp4"), tmp_path / "out")
    views, numbers, _ = read(tmp_path / "out")
    outcome = json.loads((tmp_path / "out/work/journal.json").read_text())["stages"]["frames"]["result"]
    assert len(numbers) >= 0.9 * len(outcome["indices"])
    found, expected = centres(views), made.centres[numbers]
    error = np.linalg.norm(align(found, expected).points(found) - expected, axis=1)
    assert error.max() < 0.01 * path_length(made.centres)


def test_without_a_model_there_is_no_solution(tmp_path):
    assert mapping.read_solution(tmp_path, SimpleNamespace(names=[])) is None
