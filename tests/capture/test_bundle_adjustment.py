"""Cameras that a mover pulled off, adjusted by what stands still."""

from __future__ import annotations

import numpy as np
import pytest

from scgs_warp.capture import bundle_adjustment
from scgs_warp.capture.bundle_adjustment import ROUNDS, adjust, adjust_model
from scgs_warp.capture.colmap import quiet, read_model, write_model

VIEWS, POINTS, MOVING = 12, 160, 60
WITH_MOVER = range(4, 9)
"""Views in which the mover is seen."""
FOCAL, WIDTH, HEIGHT = 500.0, 640, 480


def centre(view: float) -> np.ndarray:
    return np.array([0.4 * view - 2.2, 0.05 * np.sin(view), 0.0])


def rotation(view: int) -> np.ndarray:
    """World to camera: each looks at a point between the others' views."""
    turn = np.arctan2(centre(view)[0], 6.0)
    return np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])


def pixels(points: np.ndarray, view: int) -> np.ndarray:
    local = (points - centre(view)) @ rotation(view).T
    return FOCAL * local[:, :2] / local[:, 2:] + [WIDTH / 2, HEIGHT / 2]


@pytest.fixture
def model():
    """A reconstruction in which a mover, which nearly keeps up with the camera, passes for points far away."""
    random = np.random.default_rng(0)
    still = random.uniform([-3, -2, 4], [3, 2, 8], (POINTS, 3))
    mover = random.uniform([-0.5, -0.5, 2.5], [0.5, 0.5, 3.5], (MOVING, 3))
    bent = np.array([0.0, 0.02, 0.0])  # it leaves the epipolar lines a little
    with quiet() as pycolmap:
        made = pycolmap.Reconstruction()
        lens = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL, WIDTH, HEIGHT)
        made.add_camera_with_trivial_rig(lens)
        for view in range(VIEWS):
            away = view - WITH_MOVER[2]
            at = mover + 0.6 * (centre(view) - centre(WITH_MOVER[2])) + abs(away) * bent
            seen = np.concatenate([pixels(still, view), pixels(at, view)])
            seen += random.normal(0.0, 0.3, seen.shape)
            image = pycolmap.Image(name=f"{view}.png", points2D=[pycolmap.Point2D(p) for p in seen], camera_id=1)
            image.image_id = view + 1
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation(view)), -rotation(view) @ centre(view))
            made.add_image_with_trivial_frame(image, pose)
        for index, point in enumerate([*still, *mover]):
            track = pycolmap.Track()
            for view in range(VIEWS) if index < POINTS else WITH_MOVER:
                track.add_element(view + 1, index)
            made.add_point3D(point, track, np.zeros(3, np.uint8))
    return made


def errors(made) -> np.ndarray:
    """Distances of the cameras from the truth, as shares of the path's length."""
    found = np.stack([made.images[view + 1].projection_center() for view in range(VIEWS)])
    true = np.stack([centre(view) for view in range(VIEWS)])
    a, b = found - found.mean(0), true - true.mean(0)
    u, _, vt = np.linalg.svd(b.T @ a)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    scale = np.trace(turn @ a.T @ b) / np.square(a).sum()
    return np.linalg.norm(scale * a @ turn.T - b, axis=1) / np.linalg.norm(np.diff(true, axis=0), axis=1).sum()


def test_a_mover_no_longer_pulls_cameras(model, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(bundle_adjustment, "ROBUST", 1e4)  # squared errors, as the mapper's
        adjust(model, distortion=True)
    pulled, rounds = errors(model), []
    write_model(model, tmp_path / "model")
    assert adjust_model(tmp_path / "model", tmp_path / "adjusted", lambda: rounds.append(1))
    made = read_model(tmp_path / "adjusted")
    assert len(rounds) == ROUNDS
    assert pulled.max() > 0.005 and errors(made).max() < 0.001
    seen = [point.track.length() for _, point in sorted(made.points3D.items())]
    assert sum(seen[:POINTS]) == VIEWS * POINTS, "what stands still is seen as before"
    assert sum(seen[POINTS:]) < 0.8 * MOVING * len(WITH_MOVER), "strays are gone"


def test_cameras_that_nothing_pulled_stay_as_they_were(model, tmp_path):
    for number in sorted(model.points3D)[POINTS:]:
        model.delete_point3D(number)
    write_model(model, tmp_path / "model")
    assert not adjust_model(tmp_path / "model", tmp_path / "adjusted", lambda: None)
    assert errors(read_model(tmp_path / "adjusted")).max() < 1e-9


def test_a_model_without_points_is_left_as_it_is(model, tmp_path):
    for number in list(model.points3D):
        model.delete_point3D(number)
    write_model(model, tmp_path / "model")
    assert not adjust_model(tmp_path / "model", tmp_path / "adjusted", lambda: None)
    assert errors(read_model(tmp_path / "adjusted")).max() < 1e-9
