"""The layout of Dynamic 3D Gaussians: cameras, shared times, points, faults."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.data_faults import NAN, change, gone, message, noise, put, text
from helpers.layouts import (
    COLORS,
    POINTS,
    share_found,
    viewmat,
    write_panoptic,
)
from scgs_warp.data import load


def test_panoptic(tmp_path):
    write_panoptic(tmp_path)
    train, test = load(tmp_path, "train"), load(tmp_path, "test")
    assert share_found(train, 0.1) > 0.7 and share_found(test, 0.1) > 0.7  # JPEG
    assert train.times.tolist() == [0.0] * 3 + [0.25] * 3 + [0.5] * 3 + [0.75] * 3 + [1.0] * 3
    assert test.times.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
    np.testing.assert_allclose(train.points, POINTS, atol=1e-6)
    np.testing.assert_allclose(train.colors, COLORS / 255.0, atol=1e-6)
    np.testing.assert_allclose(test[0].camera.viewmat, viewmat(3, 0.5), atol=1e-6)
    assert len({frame.name for frame in train}) == 15


def test_names_in_other_case(tmp_path):
    write_panoptic(tmp_path)
    for file in list((tmp_path / "ims").rglob("*.jpg")):
        file.rename(file.with_suffix(".JPG"))
    assert len(load(tmp_path)) == 15


def test_panoptic_trains_with_shared_time(tmp_path):
    from helpers.tiny import tiny_config
    from scgs_warp.training.frames import Frames
    from scgs_warp.training.state import TrainState
    from scgs_warp.training.step import training_step

    write_panoptic(tmp_path)
    data = load(tmp_path)
    state = TrainState.begin(tiny_config(20), data, "cpu")
    frames = Frames(data, state.normalisation, state.config, "cpu")
    for state.step in range(3):
        assert training_step(state, frames).failed is None


META = "train_meta.json"
FAULTS = {
    "no json": (text(META, "{]"), "train_meta.json: not valid JSON"),
    "no files": (put(META, "fn", value=...), "fn is missing"),
    "files": (put(META, "fn", 0, 0, value=3), "fn[0][0] is not text"),
    "rows": (put(META, "k", value=[1, 2]), "k is missing or not a list of lists"),
    "count": (put(META, "w2c", 2, value=[]), "w2c and fn list different numbers"),
    "instants": (put(META, "k", value=[[]]), "k and fn list different numbers"),
    "nothing": (lambda folder: change(folder / META, lambda c: c.update(fn=[], k=[], w2c=[])), "fn lists no frame"),
    "pose": (put(META, "w2c", 1, 2, 0, 3, value=NAN), "w2c[1][2] is not a rigid"),
    "mirrored": (put(META, "w2c", 1, 2, value=np.diag([1.0, 1, -1, 1]).tolist()), "w2c[1][2] is not a rigid"),
    "camera": (put(META, "k", 1, 2, 0, 0, value=-5), "k[1][2] is not a 3 x 3 matrix"),
    "width": (put(META, "w", value=99), "w is 99, but the images are 80 x 60"),
    "no images": (gone("ims"), "the images of 15 of 15 frames are missing (000000.jpg, 000000.jpg, 000000.jpg"),
    "undecodable": (noise("ims/1/000002.jpg"), "000002.jpg: not an image"),
    "points": (noise("init_pt_cld.npz"), "init_pt_cld.npz: no sound numpy file"),
    "no data": (lambda folder: np.savez(folder / "init_pt_cld.npz", points=1), "no array named 'data'"),
    "shape": (lambda folder: np.savez(folder / "init_pt_cld.npz", data=np.zeros(3)), "data has shape [3]"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named(tmp_path, fault):
    edit, expected = FAULTS[fault]
    write_panoptic(tmp_path)
    edit(tmp_path)
    assert expected in message(tmp_path)


def test_a_split_that_is_not_there(tmp_path):
    write_panoptic(tmp_path)
    (tmp_path / "test_meta.json").unlink()
    assert "test_meta.json: no such file" in message(tmp_path, "test")
