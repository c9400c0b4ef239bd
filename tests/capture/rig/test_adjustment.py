"""Cameras of a rig, adjusted to dense matches: exact where features left them open, or left as they are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from helpers import textured_corner as corner
from scgs_warp.capture.bundle_adjustment import median_error
from scgs_warp.capture.colmap import quiet
from scgs_warp.capture.rig import adjustment
from scgs_warp.capture.rig.cameras import read_solution, solution_of
from scgs_warp.geometry import stereo
from scgs_warp.geometry.pinhole import pixels_of

LENSES = {"straight": 0.0, "bent": -0.12}


@pytest.fixture(scope="module", params=list(LENSES))
def rig(request, tmp_path_factory):
    true = corner.true_cameras(LENSES[request.param])
    files = corner.stills(tmp_path_factory.mktemp(request.param), true)
    return true, files, corner.model_of(true, files.names)


def test_cameras_become_exact(rig):
    true, files, model = rig
    rounds = []
    before = solution_of(model, files.names)
    after = solution_of(adjustment.adjusted(model, files, rounds.append), files.names)
    loose, exact = (corner.misplaced(each.cameras, true) for each in (before, after))
    assert loose > 0.5 and exact < 0.12, (loose, exact)
    assert after.cameras[0].params[0] == pytest.approx(corner.FOCAL, rel=0.005)
    assert after.cameras[0].params[3] == pytest.approx(true[0].params[3], abs=0.01)
    assert sum(rounds) == adjustment.ROUNDS * len(true)
    assert len(after.points) == len(before.points), "points stay those of the features"
    assert (after.colors == before.colors).all() and len(set(after.colors[:, 0].tolist())) == len(after.colors)
    again = solution_of(model, files.names)
    assert (again.points == before.points).all() and again.cameras[1].params == before.cameras[1].params


def test_stereo_of_reduced_pictures_leaves_no_holes(tmp_path, monkeypatch):
    """Wide pictures and many disparities are compared at a smaller size, which matches every second pixel only."""
    monkeypatch.setattr(stereo, "LARGEST_SIDE", 0.55 * corner.WIDTH)
    true = corner.true_cameras(angles=corner.ANGLES[1:4])
    files = corner.stills(tmp_path, true)
    found = adjustment.adjusted(corner.model_of(true, files.names), files)
    assert corner.misplaced(solution_of(found, files.names).cameras, true) < 0.15


def test_cameras_with_lenses_of_their_own(tmp_path, monkeypatch):
    monkeypatch.setattr(adjustment, "ROUNDS", 2)
    true = corner.true_cameras(angles=corner.ANGLES[1:4])
    files = corner.stills(tmp_path, true)
    found = adjustment.adjusted(corner.model_of(true, files.names, shared=False), files)
    cameras = solution_of(found, files.names).cameras
    assert len({camera.params[0] for camera in cameras.values()}) == 3
    assert [camera.params[0] for camera in cameras.values()] == pytest.approx([corner.FOCAL] * 3, rel=0.02)
    assert corner.misplaced(cameras, true) < 0.2


MIDDLE = (corner.WIDTH / 2, corner.HEIGHT / 2)
MODELS = {
    "SIMPLE_PINHOLE": (corner.FOCAL, *MIDDLE),
    "PINHOLE": (corner.FOCAL, 1.1 * corner.FOCAL, *MIDDLE),
    "RADIAL": (corner.FOCAL, *MIDDLE, -0.12, 0.03),
    "OPENCV": (corner.FOCAL, 1.1 * corner.FOCAL, *MIDDLE, -0.12, 0.03, 0.004, -0.004),
    "OPENCV_FISHEYE": (corner.FOCAL, 1.1 * corner.FOCAL, *MIDDLE, 0.05, 0.01, 0.0, 0.0),
}


@pytest.mark.parametrize("model", MODELS)
def test_lenses_of_all_models(tmp_path, model):
    true = corner.true_cameras(lens=(model, MODELS[model]))
    files = corner.stills(tmp_path, true)
    found = solution_of(adjustment.adjusted(corner.model_of(true, files.names), files), files.names)
    assert {camera.model for camera in found.cameras.values()} == {model}
    assert corner.misplaced(found.cameras, true) < 0.15


def test_pictures_of_different_sizes(tmp_path):
    """Cameras of two kinds: the wide one's pictures are cut to the size of the others'."""
    true = corner.true_cameras(angles=corner.ANGLES[1:4])
    width, height = corner.WIDTH + 64, corner.HEIGHT + 30
    lens = (0.9 * corner.FOCAL, width / 2, height / 2, -0.1)
    true[1] = true[1]._replace(params=lens, width=width, height=height)
    files = corner.stills(tmp_path, true)
    found = adjustment.adjusted(corner.model_of(true, files.names, shared=False), files)
    assert corner.misplaced(solution_of(found, files.names).cameras, true) < 0.2


def test_exact_features_still_fit(tmp_path):
    """Dense matches have the features' convention of pixels."""
    true = corner.true_cameras()
    files = corner.stills(tmp_path, true)
    found = adjustment.adjusted(corner.model_of(true, files.names, noise=0.0), files)
    assert median_error(found) < 0.15
    assert corner.misplaced(solution_of(found, files.names).cameras, true) < 0.05


def test_points_that_do_not_fit_their_pixels_are_left_out(rig):
    _, files, model = rig
    views = adjustment._views(model, files)
    true = np.array([[0.0, 0.2, 4.5], [0.3, -0.2, 4.8], [-0.4, 0.1, 4.6]])
    pixels = np.concatenate([pixels_of(view.camera, true)[0] for view in views.values()])
    seen = adjustment._Seen(np.tile(np.arange(3), len(views)), np.repeat(list(views), 3), pixels)
    points, kept = adjustment._placed(views, seen)
    np.testing.assert_allclose(points, true, atol=1e-6)
    assert kept.all()
    seen.pixels[4] += [0.0, 3 * adjustment.MOST_APART * corner.WIDTH]
    assert adjustment._placed(views, seen)[1].tolist() == [True, False, True]


def test_the_same_bits_again_and_from_a_folder(rig, tmp_path, monkeypatch):
    monkeypatch.setattr(adjustment, "ROUNDS", 1)
    _, files, model = rig
    with quiet():
        (tmp_path / "model").mkdir()
        model.write_binary(tmp_path / "model")
    assert adjustment.adjust(tmp_path / "model", files, tmp_path / "one")
    (tmp_path / "two").mkdir()
    (tmp_path / "two/points3D.bin").write_bytes(b"of an interrupted attempt")
    adjustment.adjust(tmp_path / "model", files, tmp_path / "two")
    for file in (tmp_path / "one").iterdir():
        assert file.read_bytes() == (tmp_path / "two" / file.name).read_bytes()
    assert read_solution(tmp_path / "one", files.names) is not None


def test_masked_pixels_do_not_count(tmp_path, monkeypatch):
    true = corner.true_cameras()
    mask = np.full((corner.HEIGHT, corner.WIDTH), 255, np.uint8)
    mask[60:180, 100:200] = 0
    files = corner.stills(tmp_path, true, dict.fromkeys(true, mask))
    for name in files.names[::2]:  # what moves is elsewhere in the next picture
        image = cv2.imread(str(files.folder / name))
        image[60:180, 100:200] = np.roll(image[60:180, 100:200], 9, axis=0)
        cv2.imwrite(str(files.folder / name), image)
    monkeypatch.setattr(adjustment, "ROUNDS", 2)
    used = []
    gathered = adjustment._gathered
    monkeypatch.setattr(adjustment, "_gathered", lambda *args: used.append((args[0], gathered(*args))) or used[-1][1])
    found = adjustment.adjusted(corner.model_of(true, files.names), files)
    assert corner.misplaced(solution_of(found, files.names).cameras, true) < 0.2
    for views, seen in used:
        for number, view in views.items():
            columns, rows = np.floor(seen.pixels[seen.cameras == number]).astype(int).T
            assert len(rows) > 1000 and view.still.mean() < 0.9 and view.still[rows, columns].mean() > 0.999


@pytest.mark.parametrize("lack", ["texture", "overlap", "fit"])
def test_cameras_stay_as_they_are(tmp_path, monkeypatch, lack):
    true = corner.true_cameras(angles=(-75.0, -25.0, 25.0, 75.0) if lack == "overlap" else corner.ANGLES)
    files = corner.stills(tmp_path, true)
    if lack == "texture":
        for name in files.names:
            cv2.imwrite(str(files.folder / name), np.full((corner.HEIGHT, corner.WIDTH, 3), 128, np.uint8))
    if lack == "fit":
        monkeypatch.setattr(adjustment, "ROUNDS", 1)
        monkeypatch.setattr(adjustment, "LOOSER", 0.0)
        monkeypatch.setattr(adjustment, "TOLERATED", 0.0)
    model = corner.model_of(true, files.names)
    assert adjustment.adjusted(model, files) is model
    with quiet():
        (tmp_path / "model").mkdir()
        model.write_binary(tmp_path / "model")
    assert not adjustment.adjust(tmp_path / "model", files, tmp_path / "same")
    assert (tmp_path / "same/images.bin").read_bytes() == (tmp_path / "model/images.bin").read_bytes()
