"""The Nerfies layout, which HyperNeRF and NeRF-DS share: cameras, times, splits, image scales, faults."""

from __future__ import annotations

import bisect
import json

import cv2
import numpy as np
import pytest
import torch

from helpers.data_faults import NAN, change, gone, message, noise, put, small, text
from helpers.layouts import (
    HEIGHT,
    POINTS,
    WIDTH,
    K,
    save_image,
    save_json,
    share_found,
    viewmat,
    write_nerfies,
)
from scgs_warp.data import load

FOUND = 0.75
"""Share of the points whose colour is at their pixel; the others hide."""


@pytest.mark.parametrize("lens", [(0.0, 0.0, 0.0), (-0.2, 0.05, 0.01)], ids=["straight", "bent"])
def test_nerfies(tmp_path, lens):
    write_nerfies(tmp_path, radial=lens, tangential=(0.002, -0.001) if any(lens) else (0.0, 0.0))
    train, test = load(tmp_path, "train"), load(tmp_path, "test")
    assert share_found(train, 0.02) > FOUND and share_found(test, 0.02) > FOUND
    assert (train[0].mask is not None) == any(lens)
    assert [frame.name for frame in train] == [f"{index:06d}" for index in range(1, 13, 2)]
    assert [frame.name for frame in test] == [f"{index:06d}" for index in range(2, 13, 2)]
    assert torch.equal(test.times, load(tmp_path, "val").times)
    np.testing.assert_allclose(train.times, np.arange(0, 12, 2) / 11)
    np.testing.assert_allclose(train.points, POINTS, atol=1e-6)
    np.testing.assert_allclose(train[0].camera.viewmat, viewmat(0), atol=1e-6)
    np.testing.assert_allclose(train[0].camera.K, K, atol=1e-5)


def test_nerfies_takes_the_images_that_were_made_smaller(tmp_path):
    write_nerfies(tmp_path)
    (tmp_path / "rgb/1x/000001.png").unlink()
    half = load(tmp_path, downscale=2)[0]
    assert (half.camera.width, half.camera.height) == (WIDTH // 2, HEIGHT // 2)
    np.testing.assert_allclose(half.camera.K[:2], K[:2] / 2, atol=1e-5)
    quarter = load(tmp_path, downscale=4)[0]
    expected = half.image.reshape(HEIGHT // 4, 2, WIDTH // 4, 2, 3).mean((1, 3))
    torch.testing.assert_close(quarter.image, expected, atol=1e-6, rtol=0)
    for file in (tmp_path / "rgb/1x").iterdir():
        file.unlink()
    (tmp_path / "rgb/1x").rmdir()
    assert load(tmp_path)[0].camera.width == WIDTH // 2, "the largest there are"


def test_nerfies_without_what_may_be_missing(tmp_path):
    write_nerfies(tmp_path)
    for name in ("metadata.json", "scene.json", "points.npy"):
        (tmp_path / name).unlink()
    change(tmp_path / "dataset.json", lambda content: content.update(train_ids=[], val_ids=[]))
    train, test = load(tmp_path), load(tmp_path, "test")
    assert train.points is None and [frame.name for frame in test] == ["000005"]
    assert not {frame.name for frame in train} & {frame.name for frame in test} and len(train) == 11
    assert float(test.times[0]) == pytest.approx(4 / 11)


@pytest.mark.parametrize("suffix", [".PNG", ".webp", ".JPG"])
def test_images_of_other_kinds(tmp_path, suffix):
    write_nerfies(tmp_path)
    for file in list((tmp_path / "rgb/1x").iterdir()):
        image = cv2.imread(str(file))
        file.unlink()
        encoded = cv2.imencode(suffix, image, [cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_WEBP_QUALITY, 101])[1]
        file.with_suffix(suffix).write_bytes(encoded.tobytes())
    assert share_found(load(tmp_path), 0.06) > FOUND


def test_cameras_without_a_size_have_that_of_the_images(tmp_path):
    write_nerfies(tmp_path)
    for file in (tmp_path / "camera").iterdir():
        change(file, lambda content: content.pop("image_size"))
    np.testing.assert_allclose(load(tmp_path)[0].camera.K, K, atol=1e-5)
    np.testing.assert_allclose(load(tmp_path, downscale=2)[0].camera.K[:2], K[:2] / 2, atol=1e-5)


def test_nerfies_times_of_newer_data(tmp_path):
    write_nerfies(tmp_path)
    change(tmp_path / "metadata.json", lambda content: [e.update(time_id=e["warp_id"] // 2) for e in content.values()])
    np.testing.assert_allclose(load(tmp_path).times, np.arange(6) / 5)
    assert torch.equal(load(tmp_path).times, load(tmp_path, "test").times), "two cameras at each instant"


def of_notebook(names: list[str], val_ids: list[str]) -> dict[str, dict[str, int]]:
    """Metadata as the notebook of Nerfies writes them: a held-out frame has the ``warp_id`` of the next one."""
    train_ids = sorted(set(names) - set(val_ids))
    ids = {name: index for index, name in enumerate(train_ids)}
    ids |= {name: bisect.bisect_left(train_ids, name) for name in val_ids}
    return {name: {"warp_id": ids[name], "appearance_id": ids[name], "camera_id": 0} for name in names}


def test_times_of_captures_with_the_notebook(tmp_path):
    """Held-out frames are not of the moment of a training frame; numbers in the names tell frames that were left out
    for blur."""
    write_nerfies(tmp_path)
    names = [f"{index:06d}" for index in range(1, 13) if index not in (4, 5)]
    val_ids = names[::4]
    lists = {"ids": names, "train_ids": sorted(set(names) - set(val_ids)), "val_ids": val_ids}
    save_json(tmp_path / "dataset.json", lists)
    save_json(tmp_path / "metadata.json", of_notebook(names, val_ids))
    for split in ("train", "test"):
        data = load(tmp_path, split)
        expected = [(int(frame.name) - 1) / 11 for frame in data]
        assert data.times.tolist() == pytest.approx(expected, abs=1e-6)


def test_instants_that_names_contradict_stay(tmp_path):
    write_nerfies(tmp_path)
    metadata = {f"{index:06d}": {"warp_id": [5, 5, 2][index % 3], "camera_id": 0} for index in range(1, 13)}
    save_json(tmp_path / "metadata.json", metadata)
    assert set(load(tmp_path).times.tolist()) == {0.0, 1.0}


def test_held_out_ids_are_never_trained_on(tmp_path):
    write_nerfies(tmp_path)
    change(tmp_path / "dataset.json", lambda content: content.update(train_ids=content["ids"]))
    assert [frame.name for frame in load(tmp_path)] == [f"{index:06d}" for index in range(1, 13, 2)]


def test_masks_of_nerf_ds_hide_nothing(tmp_path):
    """They are black where something moves: exactly what is to be learnt."""
    write_nerfies(tmp_path)
    for index in range(1, 13):
        save_image(tmp_path / f"mask/1x/{index:06d}.png.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    assert load(tmp_path)[0].mask is None


def test_cameras_without_distortion(tmp_path):
    write_nerfies(tmp_path)
    for file in (tmp_path / "camera").iterdir():
        camera = json.loads(file.read_text())
        file.write_text(json.dumps({**camera, "radial_distortion": None, "tangential_distortion": None}))
    assert share_found(load(tmp_path)) > 0.75


CAMERA = "camera/000003.json"
IMAGE = "rgb/1x/000003.png"
FAULTS = {
    "no json": (text("dataset.json", "{"), "dataset.json: not valid JSON"),
    "a list": (text("dataset.json", "[]"), "dataset.json: holds no JSON object"),
    "no ids": (text("dataset.json", "{}"), "ids, train_ids and val_ids are missing"),
    "ids": (put("dataset.json", "train_ids", value="all"), "train_ids is not a list"),
    "outside": (put("dataset.json", "train_ids", value=["../../x"]), "train_ids holds '../../x'"),
    "nothing left": (put("dataset.json", "train_ids", value=["000002"]), "train_ids are all among val_ids"),
    "no camera": (gone(CAMERA), "000003.json: no such file"),
    "no images": (gone("rgb/1x"), "the images of 12 of 12 frames are missing (000001.png, 000002.png, 000003.png"),
    "undecodable": (noise(IMAGE), "000003.png: not an image"),
    "size": (small(IMAGE), "image_size is 80 x 60, but the images in rgb/1x are 60 x 40"),
    "no time": (put("metadata.json", "000003", value=...), "000003.warp_id is missing"),
    "time": (put("metadata.json", "000003", "warp_id", value="late"), "000003.warp_id is missing or not a number"),
    "nan": (put(CAMERA, "position", value=[0, NAN, 0]), "position is not three finite"),
    "rotation": (put(CAMERA, "orientation", value=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]), "orientation is not a rotation"),
    "nan rotation": (put(CAMERA, "orientation", 1, 1, value=NAN), "orientation is not a rotation"),
    "focal": (put(CAMERA, "focal_length", value=...), "focal_length"),
    "negative": (put(CAMERA, "focal_length", value=-3), "focal_length"),
    "centre": (put(CAMERA, "principal_point", value=[1]), "principal_point"),
    "radial": (put(CAMERA, "radial_distortion", value=["a", 0, 0]), "radial_distortion must be three numbers"),
    "huge radial": (put(CAMERA, "radial_distortion", value=[1e300, 0, 0]), "not finite"),
    "image size": (put(CAMERA, "image_size", value=[0, 0]), "image_size is not two positive"),
    "scale": (put("scene.json", "scale", value=0), "scale is missing or not a positive"),
    "scene": (put("scene.json", "center", value=[0, 0]), "center is missing or not three"),
    "points": (noise("points.npy"), "points.npy: no sound numpy file"),
    "shape": (lambda folder: np.save(folder / "points.npy", np.zeros((3, 4))), "points.npy: has shape [3, 4]"),
    "objects": (lambda folder: np.save(folder / "points.npy", [{}], allow_pickle=True), "points.npy: no sound"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named(tmp_path, fault):
    edit, expected = FAULTS[fault]
    write_nerfies(tmp_path)
    edit(tmp_path)
    assert expected in message(tmp_path)
