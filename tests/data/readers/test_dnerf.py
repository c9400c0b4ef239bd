"""The D-NeRF layout: cameras, intrinsics, masks, faults."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image as PillowImage

from helpers.dnerf_files import HEIGHT, HUGE, WIDTH, edit, write_scene
from scgs_warp.data import load
from scgs_warp.data.points import write_points
from scgs_warp.errors import UserError
from scgs_warp.geometry.normalisation import Normalisation


def test_camera_and_times(tmp_path):
    write_scene(tmp_path / "s")
    data = load(tmp_path / "s", "train")
    assert len(data) == 3 and data.times.tolist() == [0.0, 0.5, 1.0] and data.points is None
    camera = data[0].camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    focal = 0.5 * WIDTH / math.tan(0.4)
    expected = torch.tensor([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    assert torch.allclose(camera.K, expected)
    assert torch.allclose(camera.position, torch.tensor([0.5, 0.25, 4.0]))
    # The OpenGL camera looks along -z: what lies there is in front of, and up is -y of, the OpenCV camera.
    point = camera.viewmat @ torch.tensor([0.5, 1.25, 0.0, 1.0])
    assert torch.allclose(point[:3], torch.tensor([0.0, -1.0, 4.0]))
    assert data.extent == 0.0 and data[0].name == "r_000"


def test_pixel_intrinsics_and_index_times(tmp_path):
    write_scene(tmp_path / "s", frames=3, mode="RGB", fl_x=30.0, fl_y=31.0, cx=11.0, cy=7.5, w=WIDTH, h=HEIGHT)
    edit(tmp_path / "s", lambda content: [frame.pop("time") for frame in content["frames"]])
    data = load(tmp_path / "s", "train", background="random")
    assert data[1].camera.K.tolist() == [[30.0, 0.0, 11.0], [0.0, 31.0, 7.5], [0.0, 0.0, 1.0]]
    assert data.times.tolist() == [0.0, 0.5, 1.0] and data[0].alpha is None


def test_two_angles_of_view(tmp_path):
    write_scene(tmp_path / "s", camera_angle_y=0.5)
    K = load(tmp_path / "s", "train")[0].camera.K
    assert float(K[0, 0]) == pytest.approx(0.5 * WIDTH / math.tan(0.4))
    assert float(K[1, 1]) == pytest.approx(0.5 * HEIGHT / math.tan(0.25))
    edit(tmp_path / "s", lambda content: content.update(camera_angle_y=4))
    with pytest.raises(UserError, match="camera_angle_y is 4; give radians"):
        load(tmp_path / "s", "train")


@pytest.mark.parametrize("suffix", [".tif", ".bmp", ".exr"])
def test_images_of_rare_kinds_whose_names_lack_the_suffix(tmp_path, suffix):
    """They exist, so they are not said to be missing."""
    images = write_scene(tmp_path, mode="RGB")
    for index, pixels in enumerate(images):
        file = tmp_path / f"train/r_{index:03d}.png"
        if suffix == ".exr":
            file.with_suffix(suffix).write_bytes(b"v/1\x01" + bytes(400))
        else:
            PillowImage.fromarray(pixels).save(file.with_suffix(suffix))
        file.unlink()
    if suffix == ".exr":
        with pytest.raises(UserError, match=r"r_000\.exr: not an image that decodes to 8 or 16 bits; save it again"):
            load(tmp_path)
        return
    np.testing.assert_allclose(load(tmp_path)[0].image, images[0] / 255.0, atol=1e-6)


def test_masks_of_frames(tmp_path):
    write_scene(tmp_path / "s")
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :9] = 0
    PillowImage.fromarray(mask).save(tmp_path / "s/mask.png")
    edit(tmp_path / "s", lambda content: content["frames"][1].__setitem__("mask_path", "mask.png"))
    data = load(tmp_path / "s", "train")
    assert torch.equal(data[1].mask, torch.from_numpy(mask > 0)) and data[0].mask is None


def test_held_out_frames_that_are_trained_on_are_noted(tmp_path):
    write_scene(tmp_path / "s")
    test = tmp_path / "s/transforms_test.json"
    content = json.loads(test.read_text())
    (tmp_path / "s/other.png").write_bytes((tmp_path / "s/train/r_000.png").read_bytes())
    content["frames"][0]["file_path"] = "./other"
    test.write_text(json.dumps(content))
    assert not load(tmp_path / "s", "test").notes
    (tmp_path / "s/transforms_test.json").write_text((tmp_path / "s/transforms_train.json").read_text())
    assert any("3 of 3 frames are trained on as well" in note for note in load(tmp_path / "s", "test").notes)
    assert not load(tmp_path / "s").notes


@pytest.mark.parametrize("scale", [0.01, 0.35, 40.0])
def test_the_scale_of_a_camera_does_not_count(tmp_path, scale):
    """Blender exports the scale of a camera's object, which changes nothing of its view."""
    write_scene(tmp_path / "s")
    expected = [camera.viewmat for camera in load(tmp_path / "s").cameras]

    def change(content):
        for frame in content["frames"]:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, :3] *= scale
            frame["transform_matrix"] = matrix.tolist()

    edit(tmp_path / "s", change)
    assert all(torch.allclose(camera.viewmat, view) for camera, view in zip(load(tmp_path / "s").cameras, expected))


@pytest.mark.parametrize("split", ["test", "val"])
def test_held_out_frames_alone_hide_no_other_layout(split, tmp_path):
    write_scene(tmp_path / "s")
    lone = tmp_path / f"s/transforms_{split}.json"
    (tmp_path / "s/transforms_test.json").rename(lone)
    (tmp_path / "s/transforms_train.json").rename(tmp_path / "s/transforms.json")
    assert len(load(tmp_path / "s", "train")) == 2  # one of three is held out
    (tmp_path / "s/transforms.json").unlink()
    assert len(load(tmp_path / "s", split)) == 1


def frame_field(key, value):
    return lambda content: content["frames"][1].__setitem__(key, value)


def pose_entry(row, column, value):
    return lambda content: content["frames"][1]["transform_matrix"][row].__setitem__(column, value)


BAD_CONTENT = {
    "no frames": (lambda content: content.pop("frames"), "'frames'"),
    "empty frames": (lambda content: content.__setitem__("frames", []), "'frames'"),
    "frame no object": (lambda content: content["frames"].__setitem__(1, 3), "frames[1]"),
    "nan pose": (pose_entry(0, 3, float("nan")), "frames[1].transform_matrix"),
    "scaled pose": (pose_entry(0, 0, 1.1), "not rigid"),
    "mirrored pose": (pose_entry(0, 0, -1), "not rigid"),
    "short pose": (frame_field("transform_matrix", [[1, 0], [0, 1]]), "shape [2, 2]"),
    "ragged pose": (frame_field("transform_matrix", [[1, 0], [0]]), "not a matrix"),
    "no pose": (lambda content: content["frames"][1].pop("transform_matrix"), "frames[1].transform_matrix"),
    "time text": (frame_field("time", "noon"), "frames[1].time"),
    "time null": (frame_field("time", None), "frames[1].time"),
    "time nan": (frame_field("time", float("nan")), "frames[1].time"),
    "times apart": (
        lambda content: [content["frames"][1].update(time=1.5e308), content["frames"][2].update(time=-1.5e308)],
        "the times of frames go from -1.5e+308 to 1.5e+308",
    ),
    "time absent": (lambda content: content["frames"][1].pop("time"), "frames[1].time"),
    "images missing": (
        lambda content: [entry.update(file_path="./train/nowhere") for entry in content["frames"][1:]],
        "the images of 2 of 3 frames are missing (nowhere.png, nowhere.png)",
    ),
    "path no text": (frame_field("file_path", 7), "frames[1].file_path"),
    "angle": (lambda content: content.__setitem__("camera_angle_x", -1), "camera_angle_x"),
    "no angle": (lambda content: content.pop("camera_angle_x"), "camera_angle_x"),
    "focal": (lambda content: content.__setitem__("fl_x", "long"), "fl_x"),
    "width": (lambda content: content.__setitem__("w", 99), "w is 99"),
    "distortion": (lambda content: content.__setitem__("k1", "NaN"), "k1 is 'NaN'"),
    "a frame's distortion": (frame_field("k6", 0.1), "k6 is 0.1"),
    "a frame's model": (frame_field("camera_model", "EQUIRECTANGULAR"), "camera_model is 'EQUIRECTANGULAR'"),
    "long number": (lambda content: content.__setitem__("w", HUGE), "transforms_train.json: holds a number of more"),
}


@pytest.mark.parametrize("case", BAD_CONTENT)
def test_bad_content_is_said_in_one_line(tmp_path, case):
    change, expected = BAD_CONTENT[case]
    write_scene(tmp_path / "s")
    edit(tmp_path / "s", change)
    with pytest.raises(UserError) as caught:
        load(tmp_path / "s", "train")
    message = str(caught.value)
    assert expected in message and "\n" not in message and str(tmp_path / "s") in message and ";" in message


def test_bad_files(tmp_path):
    def message(folder: Path, *args, **options) -> str:
        with pytest.raises(UserError) as caught:
            load(folder, *args, **options)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    scene = tmp_path / "s"
    assert "no such folder" in message(scene)
    scene.mkdir()
    assert "is empty" in message(scene)
    write_scene(tmp_path / "t")
    scene = tmp_path / "t"
    assert "downscale" in message(scene, downscale=0)
    assert "at most 2" in message(scene, downscale=4)
    assert "resample" in message(scene, resample="best")
    assert "background" in message(scene, background="green")
    assert "split" in message(scene, "both")
    (scene / "train/r_001.png").write_bytes(b"\x89PNG\r\n\x1a\n broken")
    assert "r_001.png" in message(scene)
    PillowImage.fromarray(np.zeros((HEIGHT, WIDTH + 1, 4), np.uint8)).save(scene / "train/r_001.png")
    assert "one size" in message(scene)
    (scene / "transforms_train.json").write_text('{"frames": [')
    assert "not valid JSON" in message(scene)
    (scene / "transforms_train.json").write_bytes(b"\xff\xfe\x00")
    assert "UTF-8" in message(scene)


def test_jumpingjacks(data_root):
    data = load(data_root / "dnerf/jumpingjacks", "test", downscale=4)
    assert len(data) == 20 and data.times[0] == 0 and data.times[-1] == 1
    assert data[0].image.shape == (200, 200, 3)
    # The figure stands at the origin, where all cameras look.
    assert all(frame.image[90:110, 90:110].mean() > 0.02 for frame in data)
    transform = Normalisation.fit(data.cameras)
    assert np.abs(transform.centre).max() < 1e-4 and transform.scale == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("mode", "varied", "taken"), [("RGB", True, True), ("RGB", False, False), ("RGBA", True, False)]
)
def test_points_of_filled_images(tmp_path, mode, varied, taken):
    """4DGS's converter of Neural 3D Video writes points; 3DGS leaves random ones, all of one grey, under this name."""
    write_scene(tmp_path, mode=mode)
    places = np.random.default_rng(1).uniform(-1.3, 1.3, (50, 3))
    colors = np.random.default_rng(2).integers(0, 256, (50, 3)) if varied else np.full((50, 3), 127)
    write_points(tmp_path / "points3d.ply", places, colors.astype(np.uint8))
    data = load(tmp_path)
    assert (data.points is not None) == taken
    if taken:
        np.testing.assert_allclose(data.points, places, atol=1e-6)
        np.testing.assert_allclose(data.colors, colors / 255.0, atol=1e-6)


def test_images_of_several_cameras_that_record_at_once(tmp_path):
    """As DiVa-360 and others list rigs without times: images of one name are of one moment."""
    write_scene(tmp_path, frames=6)
    for index in range(6):
        folder = tmp_path / f"undist/cam{index // 2:02d}"
        folder.mkdir(parents=True, exist_ok=True)
        (tmp_path / f"train/r_{index:03d}.png").rename(folder / f"{index % 2:08d}.png")

    def change(content):
        for index, entry in enumerate(content["frames"]):
            entry["file_path"] = f"undist/cam{index // 2:02d}/{index % 2:08d}.png"
            del entry["time"]

    edit(tmp_path, change)
    (tmp_path / "transforms_test.json").unlink()
    assert sorted([*load(tmp_path).times.tolist(), *load(tmp_path, "test").times.tolist()]) == [0.0] * 3 + [1.0] * 3


@pytest.mark.parametrize("more", [True, False])
def test_films_of_which_one_image_is_listed(tmp_path, more):
    """DiVa-360's files list the cameras, with the first image of each; its films are in the folders of these images."""
    write_scene(tmp_path, frames=6)
    for camera in range(6):
        folder = tmp_path / f"frames_1/cam{camera:02d}"
        folder.mkdir(parents=True)
        for instant in range(5 if more else 1):
            shutil.copy(tmp_path / f"train/r_{camera:03d}.png", folder / f"{instant:08d}.png")

    def change(content):
        for camera, entry in enumerate(content["frames"]):
            entry["file_path"] = f"frames_1/cam{camera:02d}/00000000.png"
            del entry["time"]

    edit(tmp_path, change)
    content = json.loads((tmp_path / "transforms_train.json").read_text())
    for split, cameras in (("train", slice(1, 6)), ("test", slice(0, 1))):
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(content | {"frames": content["frames"][cameras]}))
    (tmp_path / "frames_1/cam00/00000004.png").unlink(missing_ok=True)
    train, test = load(tmp_path), load(tmp_path, "test")
    if not more:
        assert train.times.tolist() == [0.0] * 5 and test.times.tolist() == [0.0]
        return
    assert train.times.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0] * 5 and test.times.tolist() == [0.0, 0.25, 0.5, 0.75]
    assert "lists one image of each of 5 cameras; all 25 images in their folders are read" in train.notes[0]


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_masks_of_the_foreground_cut_out(tmp_path, kind):
    """As GaussianAvatars names them; they count only if all are there."""
    write_scene(tmp_path, mode="RGB")
    share = np.linspace(0.0, 1.0, WIDTH)[None].repeat(HEIGHT, 0)
    (tmp_path / "fg_masks").mkdir()
    for index in range(3):
        mask = np.rint(share * np.iinfo(kind).max).astype(kind)
        PillowImage.fromarray(mask).save(tmp_path / f"fg_masks/{index}.png")

    def change(content):
        for index, entry in enumerate(content["frames"]):
            entry["fg_mask_path"] = f"fg_masks/{index}.png"

    edit(tmp_path, change)
    alpha = load(tmp_path)[0].alpha
    assert alpha is not None
    np.testing.assert_allclose(alpha, share, atol=0.003)
    (tmp_path / "fg_masks/2.png").unlink()
    assert not load(tmp_path).with_alpha
