"""Camera paths of films: both layouts, interpolation, and faults in one line."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from helpers.nerfstudio_files import FOCAL, HEIGHT, WIDTH, viewmat, write
from scgs_warp.data import load
from scgs_warp.data.camera_path import read_camera_path
from scgs_warp.errors import UserError
from scgs_warp.geometry.cameras import Overview

OVERVIEW = Overview((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 4.0, 40.0, 20.0, aspect=2.0)
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def nerfstudio(folder: Path, **changes) -> Path:
    poses = [(np.linalg.inv(viewmat(index)) @ OPENGL).ravel().tolist() for index in range(3)]
    content = {"camera_path": [{"camera_to_world": pose, "fov": 50, "aspect": 1.5} for pose in poses]}
    path = folder / "camera_path.json"
    path.write_text(json.dumps({**content, "render_width": 300, "render_height": 200, "fps": 24, **changes}))
    return path


def test_a_path_of_nerfstudio(tmp_path):
    film = read_camera_path(nerfstudio(tmp_path), OVERVIEW).film(None, 120)
    assert [time for _, time in film] == [None] * 3
    for index, (camera, _) in enumerate(film):
        assert np.abs(camera.viewmat.numpy() - viewmat(index)).max() < 1e-5
        assert (camera.width, camera.height) == (120, 80)
        assert float(camera.K[1, 1]) == pytest.approx(40 / math.tan(math.radians(25)), rel=1e-5)


def test_times_of_nerfstudio_are_followed(tmp_path):
    path = nerfstudio(tmp_path, camera_type="PERSPECTIVE")
    content = json.loads(path.read_text())
    for entry, time in zip(content["camera_path"], (0.2, 0.2, 0.7)):
        entry["render_time"] = time
    path.write_text(json.dumps(content))
    assert [time for _, time in read_camera_path(path, OVERVIEW).film(None, 120)] == [0.2, 0.2, 0.7]
    with pytest.raises(UserError, match="camera_type is equirectangular; films are perspective"):
        read_camera_path(nerfstudio(tmp_path, camera_type="equirectangular"), OVERVIEW)


def test_frames_of_a_data_set(tmp_path):
    write(tmp_path, 4)
    film = read_camera_path(tmp_path / "transforms.json", OVERVIEW).film(None, WIDTH)
    truth = {entry.name: entry for split in ("train", "test") for entry in load(tmp_path, split).entries}
    assert [time for _, time in film] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    for index, (camera, _) in enumerate(film):
        expected = truth[f"f_{index}"].camera
        assert np.abs(camera.viewmat.numpy() - expected.viewmat.numpy()).max() < 1e-5
        assert (camera.width, camera.height) == (WIDTH, HEIGHT) and float(camera.K[0, 0]) == pytest.approx(FOCAL)


def test_the_lens_of_each_frame_is_followed(tmp_path):
    """A principal point beside the middle, and pixels that are not square, at another size."""
    write(tmp_path, 3)
    content = json.loads((tmp_path / "transforms.json").read_text())
    content.update(fl_x=50.0, fl_y=75.0, w=WIDTH, h=HEIGHT, cx=0.25 * WIDTH, cy=0.75 * HEIGHT)
    content["frames"][1].update(fl_x=60.0, cx=0.5 * WIDTH)
    (tmp_path / "path.json").write_text(json.dumps(content))
    path = read_camera_path(tmp_path / "path.json", OVERVIEW)
    for frames in (None, 3):
        (first, _), (second, _), _ = path.film(frames, 2 * WIDTH)
        assert (first.width, first.height) == (2 * WIDTH, 2 * HEIGHT)
        numbers = [float(K[i, j]) for K in (first.K, second.K) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]
        middle = 1.5 * HEIGHT
        assert numbers == pytest.approx([100.0, 150.0, 0.5 * WIDTH, middle, 120.0, 150.0, WIDTH, middle], rel=1e-5)
    halfway, _ = path.film(5, WIDTH)[1]
    assert float(halfway.K[0, 2]) == pytest.approx(0.375 * WIDTH, rel=1e-5)


def test_frames_of_other_proportions_keep_their_width(tmp_path):
    write(tmp_path, 2)
    content = json.loads((tmp_path / "transforms.json").read_text())
    content.update(fl_x=50.0, fl_y=50.0, w=100, h=50, cx=50.0, cy=25.0)
    content["frames"][1].update(w=50, h=100, cx=25.0, cy=40.0)
    (tmp_path / "path.json").write_text(json.dumps(content))
    _, (upright, _) = read_camera_path(tmp_path / "path.json", OVERVIEW).film(None, 100)
    expected = [[100.0, 0.0, 50.0], [0.0, 100.0, 5.0], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(upright.K.numpy(), expected, rtol=1e-5)


@pytest.mark.parametrize(("field", "value"), [("w", 0), ("h", "tall"), ("fl_y", -5), ("cx", "middle")])
def test_faults_of_a_lens_are_named(field, value, tmp_path):
    write(tmp_path, 2)
    content = json.loads((tmp_path / "transforms.json").read_text())
    content["frames"][1].update(fl_x=50.0, w=WIDTH, h=HEIGHT)
    content["frames"][1][field] = value
    (tmp_path / "path.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match=rf"path\.json: .*\b{field}\b"):
        read_camera_path(tmp_path / "path.json", OVERVIEW)


def test_interpolation_keeps_the_given_cameras(tmp_path):
    path = read_camera_path(nerfstudio(tmp_path), OVERVIEW)
    film = path.film(5, 120)
    for index in range(3):
        assert np.abs(film[2 * index][0].viewmat.numpy() - viewmat(index)).max() < 1e-5
    between = film[1][0]
    assert np.abs(between.viewmat[:3, :3].numpy() - viewmat(0.5)[:3, :3]).max() < 1e-2  # type: ignore[arg-type]
    assert len(path.film(1, 64)) == 1


def test_what_the_file_does_not_state_comes_from_the_scene(tmp_path):
    write(tmp_path, 2)
    content = json.loads((tmp_path / "transforms.json").read_text())
    poses = {"frames": [{"transform_matrix": frame["transform_matrix"]} for frame in content["frames"]]}
    (tmp_path / "poses.json").write_text(json.dumps(poses))
    camera, time = read_camera_path(tmp_path / "poses.json", OVERVIEW).film(None, 200)[0]
    assert time is None and (camera.width, camera.height) == (200, 100)
    assert float(camera.K[0, 0]) == pytest.approx(100 / math.tan(math.radians(20)), rel=1e-5)


FAULTS = {
    "no list": ({"camera_path": {}}, "holds no list camera_path or frames"),
    "nothing": ({"camera_path": []}, "holds no list"),
    "pose": ({"camera_path": [{"camera_to_world": [1, 2]}]}, "camera_path[0].camera_to_world is not 16"),
    "NaN": ({"camera_path": [{"camera_to_world": [float("nan")] * 16}]}, "camera_to_world"),
    "not rigid": ({"camera_path": [{"camera_to_world": [2.0] * 16}]}, "is not rigid"),
    "fov": ({"camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 200}]}, "fov is 200"),
    "time": ({"camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "time": 2}]}, "time is 2"),
    "size": ({"render_width": 0}, "render_width"),
    "far": ({"camera_path": [{"camera_to_world": [*np.eye(4).ravel()[:3], 1e300, *np.eye(4).ravel()[4:]]}]}, "farther"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_named(name, tmp_path):
    changes, expected = FAULTS[name]
    path = nerfstudio(tmp_path, **changes)
    with pytest.raises(UserError) as caught:
        read_camera_path(path, OVERVIEW)
    assert expected in str(caught.value) and str(path) in str(caught.value) and "\n" not in str(caught.value)
