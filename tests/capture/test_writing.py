"""The written data set: read back with identical cameras, times and points."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from helpers.layouts import HEIGHT, POINTS, WIDTH, dots, share_found, viewmat
from scgs_warp.capture import writing
from scgs_warp.capture.features import FrameFiles
from scgs_warp.capture.mapping import CameraSolution
from scgs_warp.capture.similarity import align
from scgs_warp.data import load


def solved(params: tuple[float, ...], count: int = 10) -> CameraSolution:
    views = np.stack([viewmat(index) for index in range(count)])
    colors = np.full((len(POINTS), 3), 200, np.uint8)
    places = [index for index in range(count) if index != 3]
    return CameraSolution("SIMPLE_RADIAL", params, WIDTH, HEIGHT, places, views[places], POINTS, colors, 0.2, 9.0)


@pytest.mark.parametrize("bend", [0.0, -0.08, 0.05])
def test_the_written_folder_is_read_back_with_identical_cameras(tmp_path, bend):
    """Dots drawn through a lens are found where the written cameras, points and images say."""
    focal, cx, cy = 90.0, 40.0, 30.0

    def lens(rays: np.ndarray) -> np.ndarray:
        return focal * rays * (1 + bend * np.square(rays).sum(1, keepdims=True)) + (cx, cy)

    found = solved((focal, cx, cy, bend))
    names = [f"frame_{index:05d}.png" for index in range(10)]
    (tmp_path / "frames").mkdir()
    (tmp_path / "out").mkdir()
    for index, name in enumerate(names):
        cv2.imwrite(str(tmp_path / "frames" / name), dots(viewmat(index), lens=lens))
    shots = FrameFiles(tmp_path / "frames", names, tmp_path / "frames")
    pinhole = writing.undistort(shots, found, tmp_path / "out", lambda: None)
    seconds = [2.0 + 0.5 * index for index in range(10)]
    scene = writing.scene_of(shots, found, pinhole, seconds, (2.0, 7.0))
    writing.write_scene(tmp_path / "out", scene)
    train, test = load(tmp_path / "out"), load(tmp_path / "out", "test")
    assert len(train) == 8 and [frame.name for frame in test] == ["frame_00005"], "frame 3 has no camera"
    for data in (train, test):
        for frame in data:
            k = scene.names.index(f"{frame.name}.png")
            np.testing.assert_allclose(frame.camera.viewmat, scene.viewmats[k], atol=1e-5)
            K = [[pinhole.fx, 0, pinhole.cx], [0, pinhole.fy, pinhole.cy], [0, 0, 1]]
            np.testing.assert_allclose(frame.camera.K, K, atol=1e-4)
            assert (frame.camera.width, frame.camera.height) == (pinhole.width, pinhole.height)
            assert frame.mask is None and float(frame.time) == pytest.approx((seconds[found.places[k]] - 2) / 5)
    np.testing.assert_allclose(train.points, scene.points, atol=1e-6)
    assert (tmp_path / "out/masks" / names[0]).is_file() and not (tmp_path / "out/masks" / names[3]).exists()
    to_dots = align(scene.points, POINTS)
    for entry in train.entries:
        entry.camera.viewmat[:] = torch.from_numpy(to_dots.viewmats(entry.camera.viewmat.double().numpy()[None])[0])
    assert share_found(train, 0.1) > 0.75


@pytest.mark.parametrize("bend, reach", [(0.0, 40), (-0.02, 10), (0.02, 10)])
def test_pixels_where_the_lens_does_not_distort_stay_as_they_are(tmp_path, bend, reach):
    """All of them without distortion, else those around the principal point."""
    picture = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    for folder in ("frames", "out"):
        (tmp_path / folder).mkdir()
    cv2.imwrite(str(tmp_path / "frames/a.png"), picture)
    found = solved((90.0, 40.0, 30.0, bend), 1)
    pinhole = writing.undistort(FrameFiles(tmp_path / "frames", ["a.png"], None), found, tmp_path / "out", lambda: None)
    written = cv2.imread(str(tmp_path / "out/images/a.png"))
    assert written.shape[:2] == (pinhole.height, pinhole.width)
    left, top = 40.0 - pinhole.cx, 30.0 - pinhole.cy
    assert left == int(left) and top == int(top)
    y, x = np.indices(written.shape[:2])
    near = np.hypot(x + 0.5 - pinhole.cx, y + 0.5 - pinhole.cy) < reach
    np.testing.assert_array_equal(written[near], picture[y[near] + int(top), x[near] + int(left)])


def test_turned_photographs_do_not_tilt_the_world(tmp_path):
    """Half of them were held the other way; their cameras are turned about the optical axis."""
    found = solved((90.0, 40.0, 30.0, 0.0))
    shots = FrameFiles(tmp_path, [f"{index}.png" for index in range(10)], None)
    pinhole = writing.Pinhole(90.0, 90.0, 40.0, 30.0, 80, 60)
    seconds = [float(index) for index in range(10)]
    level = writing.scene_of(shots, found, pinhole, seconds, (0.0, 9.0))
    turns = [index % 4 for index in range(10)]
    views = found.viewmats.copy()
    for view, place in zip(views, found.places):
        angle = -np.pi / 2 * turns[place]  # the axes of an image that was turned counter-clockwise
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        view[:2] = rotation @ view[:2]
    scene = writing.scene_of(shots, found._replace(viewmats=views), pinhole, seconds, (0.0, 9.0), turns)
    np.testing.assert_allclose(scene.points, level.points, atol=1e-9)
    np.testing.assert_allclose(scene.viewmats[:, 2], level.viewmats[:, 2], atol=1e-9)
