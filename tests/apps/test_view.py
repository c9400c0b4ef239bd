"""The film app on a scene that is known exactly, and what is drawn over its renders."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.app_runs import run_app
from helpers.fake_scene import FakeScene, install
from scgs_warp.apps import view
from scgs_warp.geometry import cameras
from scgs_warp.visualization import overlay


def read_frames(folder: Path) -> list[np.ndarray]:
    return [cv2.imread(str(path))[..., ::-1].astype(int) for path in sorted(folder.iterdir())]


def film(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, *more: str, points: int = 32) -> list[np.ndarray]:
    install(monkeypatch, FakeScene(points))
    arguments = ["--run", str(tmp_path), "--output", str(tmp_path / "film"), "--size", "64", "--frames", "4"]
    assert view.cli([*arguments, "--frame", "cameras", *more]) == 0
    return read_frames(tmp_path / "film")


def same(first: np.ndarray, second: np.ndarray) -> bool:
    return bool((np.abs(first - second) <= 1).all())


def test_time_moves_the_scene_under_a_fixed_camera(monkeypatch, tmp_path) -> None:
    frames = film(monkeypatch, tmp_path, "--mode", "time")
    camera = cameras.orbit_camera(FakeScene.overview, 0.0, 64)
    for index, frame in enumerate(frames):
        truth = FakeScene().render(camera, index / 3).rgb.numpy() * 255
        assert same(frame, truth.round())
    assert not same(frames[0], frames[1])


def test_turntable_moves_the_camera_round_a_standing_scene(monkeypatch, tmp_path) -> None:
    frames = film(monkeypatch, tmp_path, "--mode", "turntable", "--time", "0.25")
    for index, frame in enumerate(frames):
        camera = cameras.orbit_camera(FakeScene.overview, 90.0 * index, 64)
        assert same(frame, (FakeScene().render(camera, 0.25).rgb.numpy() * 255).round())


@pytest.mark.parametrize(("name", "shape"), [("odd", (37, 37)), ("odd.gif", (37, 37)), ("odd.mp4", (36, 36))])
@pytest.mark.parametrize("mode", ["turntable", "time"])
def test_only_films_that_need_even_sides_have_them(monkeypatch, tmp_path, capsys, name, shape, mode) -> None:
    install(monkeypatch, FakeScene())
    more = ["--size", "37", "--frames", "2", "--frame", "cameras", "--mode", mode]
    assert view.cli(["--run", str(tmp_path), "--output", str(tmp_path / name), *more]) == 0
    assert f"2 frames of {shape[1]} x {shape[0]}" in capsys.readouterr().out
    if name == "odd":
        assert [frame.shape[:2] for frame in read_frames(tmp_path / name)] == [shape] * 2


def test_a_time_alone_is_that_of_the_whole_film(monkeypatch, tmp_path) -> None:
    named = film(monkeypatch, tmp_path, "--mode", "turntable", "--time", "0.25")
    assert all(same(a, b) for a, b in zip(film(monkeypatch, tmp_path, "--time", "0.25"), named, strict=True))


def test_a_camera_path_and_its_times(monkeypatch, tmp_path) -> None:
    poses = [cameras.orbit_camera(FakeScene.overview, azimuth, 64) for azimuth in (0.0, 40.0)]
    flipped = np.diag([1.0, -1.0, -1.0, 1.0])
    entries = [
        {"transform_matrix": (np.linalg.inv(pose.viewmat.double().numpy()) @ flipped).tolist(), "time": time}
        for pose, time in zip(poses, (0.25, 0.75))
    ]
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"camera_angle_x": math.radians(FakeScene.overview.fov_x), "frames": entries}))
    install(monkeypatch, FakeScene())
    output = tmp_path / "film"
    arguments = ["--run", str(tmp_path), "--output", str(output), "--size", "64", "--path", str(path)]
    assert view.cli(arguments) == 0
    frames = read_frames(output)
    assert len(frames) == 2
    for frame, camera, time in zip(frames, poses, (0.25, 0.75)):
        assert same(frame, (FakeScene().render(camera, time).rgb.numpy() * 255).round())
    assert view.cli([*arguments, "--frames", "5", "--output", str(tmp_path / "longer")]) == 0
    assert len(read_frames(tmp_path / "longer")) == 5
    assert view.cli([*arguments, "--zoom", "2"]) == 2


def test_an_unfinished_run_is_shown_and_said_to_be_unfinished(monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setattr(FakeScene, "unfinished", "step 3,304 of 7,000, unfinished")
    film(monkeypatch, tmp_path)
    assert "step 3,304 of 7,000, unfinished" in capsys.readouterr().out


@pytest.mark.parametrize("show", ["depth", "alpha", "nodes", "trajectories"])
@pytest.mark.parametrize("name", ["film.mp4", "film.gif"])
def test_every_way_to_look_at_it(monkeypatch, tmp_path, show: str, name: str) -> None:
    install(monkeypatch, FakeScene())
    path = tmp_path / name
    arguments = ["--run", str(tmp_path), "--output", str(path), "--frames", "3", "--size", "48", "--show", show]
    assert view.cli(arguments) == 0
    assert path.stat().st_size > 300
    assert [entry.name for entry in tmp_path.iterdir()] == [name]


def test_trails_without_control_points_follow_gaussians(monkeypatch, tmp_path) -> None:
    plain = film(monkeypatch, tmp_path, "--mode", "time", points=0)
    trails = film(monkeypatch, tmp_path, "--mode", "time", "--show", "trajectories", points=0)
    changed = [int((np.abs(trail - np.floor(frame * 0.5)) > 1).any(-1).sum()) for trail, frame in zip(trails, plain)]
    assert changed[0] < 10 < changed[2]  # at time 0 nothing has moved: dots, no lines


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--frames", "0"], "--frames 0"),
        (["--frames", "1000000000"], "--frames 1000000000: give 1 to 100,000"),
        (["--size", "15"], "--size 15"),
        (["--fps", "0"], "--fps 0"),
        (["--time", "1.5"], "--time 1.5"),
        (["--time", "0.5", "--mode", "time"], "--mode time shows all times"),
        (["--output", "film.avi"], "film.avi"),
        (["--run", "missing"], "missing"),
        (["--threads", "0"], "--threads 0"),
        (["--zoom", "0"], "--zoom 0"),
        (["--path", "no.json"], "no.json: no such file"),
    ],
)
def test_mistakes_are_one_line_and_status_2(monkeypatch, tmp_path, capsys, arguments: list[str], words: str) -> None:
    install(monkeypatch, FakeScene())
    given = {"--run": str(tmp_path), "--output": str(tmp_path / "film.mp4")}
    given.update(zip(arguments[::2], arguments[1::2]))
    assert view.cli([word for pair in given.items() for word in pair]) == 2
    captured = capsys.readouterr()
    assert words in captured.err and captured.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_nodes_of_a_model_without_any(monkeypatch, tmp_path, capsys) -> None:
    install(monkeypatch, FakeScene(0))
    output = str(tmp_path / "film.mp4")
    assert view.cli(["--run", str(tmp_path), "--output", output, "--show", "nodes"]) == 2
    assert "no control points" in capsys.readouterr().err


def test_points_are_drawn_where_they_are_and_fade_behind_the_surface() -> None:
    scene = FakeScene()
    camera = cameras.orbit_camera(scene.overview, 0.0, 200)
    towards = camera.position / camera.position.norm()
    resting = torch.stack([0.4 * towards, -0.4 * towards])  # the near and the far pole of the ball at the origin
    image = scene.render(camera, 0.5)  # the other ball is aside
    colors = np.array([[0, 255, 0], [255, 0, 255]], np.uint8)
    black = np.zeros((200, 200, 3), np.uint8)
    near = overlay.draw_points(black, resting[:1], camera, colors[:1], image)
    far = overlay.draw_points(black, resting[1:], camera, colors[1:], image)
    place = overlay.project_points(resting, camera)[0].astype(int)
    assert near[place[0, 1], place[0, 0]].tolist() == [0, 255, 0]
    assert 40 < far[place[1, 1], place[1, 0], 0] < 80  # a quarter of 255
    assert black.max() == 0
    unhidden = overlay.draw_points(black, resting[1:], camera, colors[1:])
    assert unhidden[place[1, 1], place[1, 0]].tolist() == [255, 0, 255]


def test_nothing_to_draw_and_points_behind_the_camera() -> None:
    camera = cameras.orbit_camera(FakeScene.overview, 0.0, 32)
    grey = np.full((32, 32, 3), 90, np.uint8)
    behind = 2 * camera.position[None]
    wild = torch.tensor([[float("nan")] * 3, [1e30] * 3, [float("inf"), 0, 0]])
    image = FakeScene().render(camera, 0.0)
    for points in (torch.zeros(0, 3), behind, wild):
        colors = np.zeros((len(points), 3), np.uint8)
        np.testing.assert_array_equal(overlay.draw_points(grey, points, camera, colors, image), grey)
        tracks = np.repeat(points.numpy()[None], 3, axis=0)
        np.testing.assert_array_equal(overlay.draw_trails(grey, tracks, camera, image), grey)


def test_depth_colours_near_warm_far_cold() -> None:
    camera = cameras.orbit_camera(FakeScene.overview, 0.0, 100)
    image = FakeScene().render(camera, 0.0)  # one ball before the other
    near, far = overlay.depth_range([image])
    seen = image.depth[image.alpha > 0]
    assert near <= seen.quantile(0.02) and far >= seen.quantile(0.98)
    colors = overlay.color_depth(image, near, far).astype(int)
    nearest = colors[image.depth.numpy() == seen.min().item()][0]
    farthest = colors[image.depth.numpy() == seen.max().item()][0]
    assert nearest[0] > nearest[2] + 100 and farthest[2] > farthest[0] + 50
    assert (colors[image.alpha.numpy() == 0] == 0).all()
    assert overlay.depth_range([]) == (0.0, 1.0)


def test_tracks_interpolate_between_samples() -> None:
    tracks = np.arange(5.0)[:, None, None] * np.ones((1, 2, 3))
    found = overlay.interpolate_tracks(tracks, np.array([0.0, 0.125, 0.5, 1.0, 1.5]))
    np.testing.assert_allclose(found[:, 0, 0], [0.0, 0.5, 2.0, 4.0, 4.0])
    np.testing.assert_allclose(overlay.interpolate_tracks(tracks[:1], np.array([0.3]))[:, 0, 0], [0.0])


@pytest.mark.parametrize("show", ["rgb", "trajectories"])
def test_a_trained_run(trained, tmp_path, show):
    output = tmp_path / "film.gif"
    done = run_app(
        "view", "--run", str(trained), "--frames", "3", "--size", "32", "--show", show, "--output", str(output)
    )
    assert done.returncode == 0, done.stderr
    assert output.stat().st_size > 100


def test_a_film_of_the_mean_of_two_runs(trained, other_seed, tmp_path) -> None:
    films = [tmp_path / name for name in ("one", "other", "mean")]
    for film, runs in zip(films, ([trained], [other_seed], [trained, "--also", other_seed])):
        words = map(str, ["--run", *runs, "--frames", 2, "--size", 32, "--output", film])
        done = run_app("view", *words)
        assert done.returncode == 0, done.stderr
    one, other, mean = (np.stack(read_frames(film)).astype(float) for film in films)
    assert np.abs(mean - (one + other) / 2).max() <= 1.0 and np.abs(one - other).max() > 8.0


def test_control_points_have_no_mean(tmp_path, capsys) -> None:
    words = ["--run", "a", "--also", "b", "--show", "nodes", "--output", str(tmp_path / "a.mp4")]
    assert view.cli(words) == 2
    assert "control points have no mean; leave out --show nodes" in capsys.readouterr().err


@pytest.mark.parametrize("more", [["--ply", "a.ply"], ["--run", "a", "--live"]])
def test_a_mean_is_of_runs_and_for_films(more, capsys) -> None:
    assert view.cli([*more, "--also", "b", *([] if "--live" in more else ["--output", "a.mp4"])]) == 2
    assert "--also: takes runs beside --run, for films" in capsys.readouterr().err


def test_a_folder_without_a_run(tmp_path) -> None:
    done = run_app("view", "--run", str(tmp_path), "--output", str(tmp_path / "a.gif"))
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr
