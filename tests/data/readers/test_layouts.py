"""Every layout that is read, written as its own programs write it: cameras, times, splits, points, lenses."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import torch

from helpers.layouts import (
    COLORS,
    FOCAL,
    HEIGHT,
    POINTS,
    WIDTH,
    K,
    save_image,
    share_found,
    viewmat,
    write_colmap,
    write_nerfies,
    write_panoptic,
    write_poses_bounds,
)
from scgs_warp.data import load
from scgs_warp.data.readers import colmap
from scgs_warp.errors import UserError

FOUND = 0.75
"""Share of the points whose colour is at their pixel; the others hide."""


def change(path, edit) -> None:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def test_the_measure_notices_three_pixels(tmp_path):
    write_colmap(tmp_path)
    data = load(tmp_path)
    for entry in data.entries:
        entry.camera.K[0, 2] += 3
    assert share_found(data) < 0.2


# HyperNeRF, NeRF-DS


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


def test_nerfies_times_of_newer_data(tmp_path):
    write_nerfies(tmp_path)
    change(tmp_path / "metadata.json", lambda content: [e.update(time_id=e["warp_id"] // 2) for e in content.values()])
    np.testing.assert_allclose(load(tmp_path).times, np.arange(6) / 5)
    assert torch.equal(load(tmp_path).times, load(tmp_path, "test").times), "two cameras at each instant"


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


# Dynamic 3D Gaussians


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


# Neural 3D Video


@pytest.mark.parametrize("inner", ["images", "."])
def test_poses_bounds(tmp_path, inner):
    write_poses_bounds(tmp_path, inner=inner)
    train, test = load(tmp_path, "train"), load(tmp_path, "test")
    assert share_found(train) > FOUND and share_found(test) > FOUND
    assert [frame.name for frame in test] == ["cam00_0000", "cam00_0001", "cam00_0002"]
    assert train.times.tolist() == [0.0, 0.5, 1.0] * 3 and len(train) == 9
    np.testing.assert_allclose(test[0].camera.viewmat, viewmat(0, 0.4), atol=1e-6)


def test_poses_bounds_of_reduced_images(tmp_path):
    write_poses_bounds(tmp_path)
    for file in tmp_path.glob("cam*/images/*.png"):
        image = cv2.imread(str(file))
        cv2.imwrite(str(file), cv2.resize(image, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA))
    camera = load(tmp_path)[0].camera
    assert [float(camera.K[0, 0]), float(camera.K[1, 2])] == [FOCAL / 2, HEIGHT / 4]


def test_videos_are_to_be_unpacked(tmp_path):
    write_poses_bounds(tmp_path)
    for camera in range(4):
        for file in (tmp_path / f"cam{camera:02d}/images").iterdir():
            file.unlink()
        (tmp_path / f"cam{camera:02d}.mp4").write_bytes(b"film")
    with pytest.raises(UserError, match=r"cam00\.mp4: a video, not images; .*ffmpeg -i"):
        load(tmp_path)


# COLMAP

MODELS = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]
MODELS += ["SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "FOV"]


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("model", MODELS)
def test_colmap(tmp_path, model, text):
    write_colmap(tmp_path, model=model, text=text)
    train, test = load(tmp_path, "train"), load(tmp_path, "test")
    assert share_found(train, 0.02) > FOUND and share_found(test, 0.02) > FOUND
    assert (train[0].mask is None) == (model in ("SIMPLE_PINHOLE", "PINHOLE"))
    assert [frame.name for frame in test] == ["frame_5", "frame_13"]
    assert not {frame.name for frame in train} & {frame.name for frame in test} and len(train) == 12
    np.testing.assert_allclose(train.points, POINTS, atol=1e-6)
    np.testing.assert_allclose(train.colors, COLORS / 255.0, atol=1e-6)
    np.testing.assert_allclose(train[0].camera.viewmat, viewmat(0), atol=1e-6)
    np.testing.assert_allclose(test.times, [4 / 13, 12 / 13], atol=1e-6)


def test_colmap_is_found_where_it_is_left(tmp_path):
    write_colmap(tmp_path)
    expected = load(tmp_path).fingerprint
    (tmp_path / "sparse/0").rename(tmp_path / "moved")
    (tmp_path / "sparse").rmdir()
    for place in ("sparse", "colmap/sparse/0", "sparse/3"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "moved").rename(tmp_path / place)
        assert load(tmp_path).fingerprint == expected, place
        (tmp_path / place).rename(tmp_path / "moved")


def test_colmap_takes_the_largest_model(tmp_path):
    write_colmap(tmp_path, count=14)
    write_colmap(tmp_path / "other", count=4)
    (tmp_path / "sparse/0").rename(tmp_path / "sparse/1")
    (tmp_path / "other/sparse/0").rename(tmp_path / "sparse/0")
    assert len(load(tmp_path)) == 12


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["frame_9.png", "frame_10.png", "frame_12.png"], [0.0, 1 / 3, 1.0]),  # 11 was not registered
        (["left/1.png", "left/2.png", "right/1.png"], [0.0, 1.0, 0.0]),
        (["a.png", "b.png", "c.png"], [0.0, 0.5, 1.0]),
        (["a1.png", "b.png", "c1.png"], [0.0, 0.5, 1.0]),
        (["7.png", "b7.png", "c7.png"], [0.0, 0.5, 1.0]),
        (["only 1.png"], [0.0]),
    ],
)
def test_times_in_names(names, expected):
    assert colmap.times_from_names(names) == pytest.approx(expected)


def test_any_names(tmp_path):
    names = ["Kamera A/Bild (3).png", "Kamera A/Bild (4).png", "π/x.png", "b b.png"]
    write_colmap(tmp_path, count=4, names=lambda index: names[index])
    assert share_found(load(tmp_path)) > FOUND
    (tmp_path / "text").mkdir()
    write_colmap(tmp_path / "text", count=4, names=lambda index: names[index], text=True)
    assert {frame.name for frame in load(tmp_path / "text")} == {frame.name for frame in load(tmp_path)}


def test_cameras_of_different_sizes(tmp_path):
    """Phones and drones in one model: sizes may differ between images, not between an image and its camera."""
    import pycolmap

    write_colmap(tmp_path)
    place = tmp_path / "sparse/0"
    reconstruction = pycolmap.Reconstruction(str(place))
    wide = pycolmap.Camera(
        model="PINHOLE", width=WIDTH + 2, height=HEIGHT, params=K[[0, 1, 0, 1], [0, 1, 2, 2]], camera_id=9
    )
    reconstruction.add_camera_with_trivial_rig(wide)
    image = pycolmap.Image(name="wide_99.png", camera_id=9, image_id=99)
    view = viewmat(3)
    reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(view[:3, :3]), view[:3, 3]))
    reconstruction.write_binary(str(place))
    save_image(tmp_path / "images/wide_99.png", np.full((HEIGHT, WIDTH + 2, 3), 90, np.uint8))
    data = load(tmp_path)
    assert {frame.camera.width for frame in data} == {WIDTH, WIDTH + 2}


def test_a_model_of_other_images(data_root):
    folder = data_root / "colmap"
    if not folder.is_dir():
        pytest.skip("no such model here")
    with pytest.raises(UserError, match=r"camera \d+, of \d+\.jpg, is of 269\d x 20\d\d pixels, but the image is 2704"):
        load(folder)


def test_a_video_is_the_same_from_transforms_and_from_colmap(data_root, tmp_path):
    """The handheld video, and a model that pycolmap writes of its poses and points: the same frames to train on."""
    import pycolmap

    folder = data_root / "handheld"
    if not folder.is_dir():
        pytest.skip("no such video here")
    reconstruction = pycolmap.Reconstruction()
    splits = {split: load(folder, split, downscale=4, cache_mib=0) for split in ("train", "test")}
    content = json.loads((folder / "transforms.json").read_text())
    params = [content[key] for key in ("fl_x", "fl_y", "cx", "cy")]
    camera = pycolmap.Camera(model="PINHOLE", width=content["w"], height=content["h"], params=params, camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    for point, color in zip(splits["train"].points.tolist(), (splits["train"].colors * 255).round().byte().numpy()):
        reconstruction.add_point3D(np.array(point), pycolmap.Track(), color)
    entries = sorted((e for data in splits.values() for e in data.entries), key=lambda entry: entry.name)
    for index, entry in enumerate(entries):
        view = entry.camera.viewmat.double().numpy()
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(view[:3, :3]), view[:3, 3])
        image = pycolmap.Image(name=f"{entry.name}.png", camera_id=1, image_id=index + 1)
        reconstruction.add_image_with_trivial_frame(image, pose)
    (tmp_path / "sparse/0").mkdir(parents=True)
    reconstruction.write_binary(str(tmp_path / "sparse/0"))
    (tmp_path / "images").symlink_to((folder / "images").resolve())
    for split, expected in splits.items():
        data = load(tmp_path, split, downscale=4, cache_mib=0)
        assert [frame.name for frame in data.entries] == [frame.name for frame in expected.entries]
        torch.testing.assert_close(data.times, expected.times, atol=1e-6, rtol=0)
        torch.testing.assert_close(data.points, expected.points)
        for ours, theirs in zip(data, expected):
            torch.testing.assert_close(ours.camera.viewmat, theirs.camera.viewmat, atol=1e-5, rtol=1e-5)
            torch.testing.assert_close(ours.camera.K, theirs.camera.K)
            assert torch.equal(ours.image, theirs.image) and torch.equal(ours.mask, theirs.mask)
