"""The nerfstudio layout: splits, times, masks, borders, points, faults."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.nerfstudio_files import COLORS, FOCAL, HEIGHT, POINTS, WIDTH, save, write, write_ply
from scgs_warp.data import load
from scgs_warp.errors import UserError


def message(folder: Path, split: str = "train") -> str:
    with pytest.raises(UserError) as caught:
        load(folder, split)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def share_of_colors_found(data) -> float:
    """How often the pixel a point projects to has the point's colour."""
    found = []
    for frame in data:
        camera = frame.camera
        pixels = (data.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
        pixels = (pixels[:, :2] / pixels[:, 2:]).floor().long()
        inside = ((pixels >= 0) & (pixels < torch.tensor([camera.width, camera.height]))).all(1)
        seen = frame.image[pixels[inside, 1], pixels[inside, 0]]
        found.append(((seen - data.colors[inside]).abs().amax(1) < 1e-3).float().mean())
    return float(torch.stack(found).mean())


def test_points_project_onto_their_pixels(tmp_path):
    write(tmp_path)
    data = load(tmp_path)
    assert data.points.shape == data.colors.shape == (60, 3)
    assert share_of_colors_found(data) > 0.8  # some dots hide behind others
    assert data[0].alpha is None and data[0].mask is None
    half = load(tmp_path, downscale=2)[0].camera
    assert (half.width, half.height, float(half.K[0, 0]), float(half.K[1, 1])) == (20, 15, FOCAL / 2, FOCAL / 2)


def test_splits_by_list_and_by_every_eighth(tmp_path):
    content = write(tmp_path)
    assert [frame.name for frame in load(tmp_path, "test")] == ["f_4", "f_12"]
    assert [frame.name for frame in load(tmp_path, "val")] == ["f_4", "f_12"]
    assert len(load(tmp_path, "train")) == 18
    save(tmp_path, {**content, "train_filenames": ["f_3.png", "f_1.png"], "test_filenames": ["f_0.png"]})
    assert [frame.name for frame in load(tmp_path, "train")] == ["f_1", "f_3"]
    assert [frame.name for frame in load(tmp_path, "val")] == ["f_0"]
    lists = {"train_filenames": ["f_3.png"], "val_filenames": ["f_0.png"], "test_filenames": []}
    save(tmp_path, {**content, **lists})
    assert [frame.name for frame in load(tmp_path, "test")] == ["f_0"]
    save(tmp_path, {**content, **lists, "val_filenames": [], "test_filenames": ["f_5.png"]})
    assert [frame.name for frame in load(tmp_path, "val")] == ["f_5"]
    save(tmp_path, {**content, **lists, "val_filenames": []})
    assert "test_filenames is missing" in message(tmp_path, "test")
    save(tmp_path, {**content, "train_filenames": ["f_3.png"]})
    assert "test_filenames is missing" in message(tmp_path, "test")
    save(tmp_path, {**content, "train_filenames": ["f_0.png", "f_3.png"], "test_filenames": ["f_0.png"]})
    assert [frame.name for frame in load(tmp_path, "train")] == ["f_3"], "what is held out is not trained on"
    for others in (["f_0.png", "f_3.png"], None):
        save(tmp_path, {**content, "train_filenames": ["f_0.png"], "val_filenames": others})
        assert [frame.name for frame in load(tmp_path, "train")] == ["f_0"]
    save(tmp_path, {**content, "train_filenames": ["f_99.png"]})
    assert "train_filenames names 'f_99.png'" in message(tmp_path)


def test_times_follow_the_names_where_there_are_none(tmp_path):
    content = write(tmp_path)
    for entry in content["frames"]:
        del entry["time"]
    content["frames"].sort(key=lambda entry: entry["file_path"])  # f_0, f_1, f_10, f_11, ...
    save(tmp_path, content)
    times = {frame.name: frame.time for frame in load(tmp_path)}
    assert times["f_9"] == 9 / 19 and times["f_10"] == 10 / 19


def test_cameras_that_record_at_once_share_their_times(tmp_path):
    """Folders whose images have the same names are cameras of one moment each; others follow one another."""
    content = write(tmp_path)
    for index, entry in enumerate(content["frames"]):
        del entry["time"]
        name = f"cam{index % 2}/{index // 2:03d}.png"
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / entry["file_path"]).rename(tmp_path / name)
        entry["file_path"] = name
    save(tmp_path, {**content, "train_filenames": [entry["file_path"] for entry in content["frames"]]})
    assert np.allclose(load(tmp_path).times, [index // 2 / 9 for index in range(20)])


def test_depth_maps_of_decimals_without_a_unit_are_noted(tmp_path):
    content = write(tmp_path)
    np.save(tmp_path / "depth.npy", np.full((HEIGHT, WIDTH), 4.0, np.float32))
    for entry in content["frames"]:
        entry["depth_file_path"] = "depth.npy"
    save(tmp_path, content)
    assert any("read as millimetres" in note for note in load(tmp_path).notes)
    save(tmp_path, {**content, "depth_unit_scale_factor": 1.0})
    assert not any("millimetres" in note for note in load(tmp_path).notes)


def test_depth_maps_that_are_missing(tmp_path):
    """Exports are often copied without them."""
    content = write(tmp_path)
    for index, entry in enumerate(content["frames"]):
        entry["depth_file_path"] = f"depth_{index}.npy"
    save(tmp_path, {**content, "depth_unit_scale_factor": 1.0})
    data = load(tmp_path)
    assert data.with_depth == [] and "18 of 18 depth maps are missing" in data.notes[-1]
    np.save(tmp_path / "depth_0.npy", np.full((HEIGHT, WIDTH), 4.0, np.float32))
    data = load(tmp_path)
    assert data.with_depth == [0] and "17 of 18 depth maps are missing" in data.notes[-1]


def test_intrinsics_of_a_frame_win(tmp_path):
    content = write(tmp_path)
    content["frames"][2] |= {"fl_x": 60.0, "fl_y": 70.0, "cx": 21.0}
    save(tmp_path, content)
    K = load(tmp_path)[2].camera.K
    assert [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])] == [60.0, 70.0, 21.0, 15.0]


@pytest.mark.parametrize("points_too", [True, False])
def test_applied_transform_is_followed_whichever_way_it_was_meant(tmp_path, points_too):
    content = write(tmp_path)
    turn = np.array([[0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 1.0, -5.0], [1.0, 0.0, 0.0, 2.0]])
    for entry in content["frames"]:
        pose = np.array(entry["transform_matrix"])
        entry["transform_matrix"] = (np.vstack([turn, [0, 0, 0, 1]]) @ pose).tolist()
    save(tmp_path, {**content, "applied_transform": turn.tolist()})
    if points_too:
        write_ply(tmp_path / "points.ply", POINTS @ turn[:, :3].T + turn[:, 3], COLORS)
    assert share_of_colors_found(load(tmp_path)) > 0.8


def test_a_scene_far_from_the_origin(tmp_path):
    far = np.array([5e5, 5.4e6, 300.0])
    content = write(tmp_path)
    for entry in content["frames"]:
        pose = np.array(entry["transform_matrix"])
        pose[:3, 3] += far
        entry["transform_matrix"] = pose.tolist()
    save(tmp_path, content)
    write_ply(tmp_path / "points.ply", POINTS, COLORS, far)
    train, test = load(tmp_path), load(tmp_path, "test")
    assert share_of_colors_found(train) > 0.8 and train.notes[-1] == test.notes[-1]
    assert "is subtracted from all cameras and points" in train.notes[-1]


def test_a_black_border_is_masked_but_nothing_dark_inside(tmp_path):
    write(tmp_path)
    for index in range(20):
        image = cv2.imread(str(tmp_path / f"f_{index}.png"))
        image[0, 10:20] = 2  # a border, not quite black
        image[20:24, 20:24] = 0  # something black, inside
        if index % 2:
            image[:, :2] = 0  # a dark sleeve that comes and goes
        cv2.imwrite(str(tmp_path / f"f_{index}.png"), image)
    for split in ("train", "test"):
        mask = load(tmp_path, split)[0].mask
        expected = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
        expected[:2, 9:21] = False
        assert torch.equal(mask, expected)
    small = load(tmp_path, downscale=2)[0].mask
    assert not small[0, 4:11].any() and small[1:].all()


def test_lists_may_write_names_in_other_ways(tmp_path):
    content = write(tmp_path)
    for form in ("./{}", ".\\{}", "{}"):
        lists = {"train_filenames": [form.format("f_3.png")], "test_filenames": [form.format("f_0.png")]}
        save(tmp_path, {**content, **lists})
        assert [frame.name for frame in load(tmp_path, "train")] == ["f_3"]
    (tmp_path / "inner").mkdir()
    for frame in content["frames"]:
        (tmp_path / frame["file_path"]).rename(tmp_path / "inner" / frame["file_path"])
        frame["file_path"] = f"inner/{frame['file_path']}"
    save(tmp_path, {**content, **lists})
    assert [frame.name for frame in load(tmp_path, "test")] == ["f_0"], "the name alone"
    twice = {**content["frames"][0], "file_path": "other/f_0.png"}
    (tmp_path / "other").mkdir()
    (tmp_path / "other/f_0.png").write_bytes((tmp_path / "inner/f_0.png").read_bytes())
    save(tmp_path, {**content, **lists, "frames": [*content["frames"], twice]})
    assert "test_filenames names 'f_0.png'" in message(tmp_path, "test"), "of two frames"


def test_fields_that_programs_leave_empty(tmp_path):
    content = write(tmp_path)
    expected = load(tmp_path).times
    for frame in content["frames"]:
        frame.update(time=None, mask_path="", depth_file_path="")
    save(tmp_path, content)
    assert (
        load(tmp_path)[0].mask is None and not load(tmp_path).with_depth and len(load(tmp_path).times) == len(expected)
    )
    content["frames"][1]["time"] = 0.5
    save(tmp_path, content)
    assert "frames[0].time is missing" in message(tmp_path)


def test_fields_of_the_whole_file_that_programs_leave_empty(tmp_path):
    empty = ("k1", "p1", "camera_model", "distortion_params", "applied_transform", "cy", "is_fisheye")
    write(tmp_path, **dict.fromkeys(empty), ply_file_path="")
    data = load(tmp_path)
    assert data.points is None and float(data[0].camera.K[1, 2]) == HEIGHT / 2


def test_images_that_were_converted(tmp_path):
    """The names keep their suffix; a note says so."""
    write(tmp_path)
    for file in list(tmp_path.glob("*.png")):
        cv2.imwrite(str(file.with_suffix(".webp")), cv2.imread(str(file)), [cv2.IMWRITE_WEBP_QUALITY, 101])
        file.unlink()
    data = load(tmp_path)
    assert len(data) == 18
    assert any("images of other names than listed are used, such as f_0.webp for f_0.png" in n for n in data.notes)
    write(tmp_path, frames=[{**f, "file_path": f["file_path"][:-4]} for f in write(tmp_path)["frames"]])
    assert not load(tmp_path).notes, "names without a suffix are of any"


@pytest.mark.parametrize(("first", "length"), [(1700000000.0, 12.5), (-0.5, 1.0)])
def test_times_in_seconds(tmp_path, first, length):
    content = write(tmp_path)
    expected = load(tmp_path).times
    for frame in content["frames"]:
        frame["time"] = first + length * frame["time"]
    save(tmp_path, content)
    data = load(tmp_path)
    assert torch.allclose(data.times, expected) and "are scaled to go from 0 to 1" in data.notes[0]


def test_frames_that_repeat_others_are_left_out(tmp_path):
    """Else the copy of a held-out frame would be trained on."""
    content = write(tmp_path, 10)
    frames = content["frames"]
    again = {**frames[2], "time": 0.9}
    save(tmp_path, {**content, "frames": [*frames, *frames, again]})
    train, test = load(tmp_path), load(tmp_path, "test")
    assert len(train) + len(test) == 11 and not {frame.name for frame in train} & {frame.name for frame in test}
    assert "10 of 21 frames are left out, because they repeat others (f_0.png" in train.notes[0]
    lists = {"train_filenames": ["f_1.png", "f_2.png"], "test_filenames": ["f_3.png"]}
    save(tmp_path, {**content, **lists, "frames": [*frames, *frames]})
    assert [frame.name for frame in load(tmp_path)] == ["f_1", "f_2"]


def test_images_of_several_sizes(tmp_path):
    """As of a phone that is turned while it films; each frame states its size."""
    content = write(tmp_path)
    for key in ("w", "h", "cx", "cy"):
        content.pop(key)
    for frame in content["frames"][::2]:
        file = str(tmp_path / frame["file_path"])
        image = cv2.imread(file)
        assert image is not None
        cv2.imwrite(file, image[:, :24])
    save(tmp_path, content)
    assert "give all images of a split one size, or each frame its w and h" in message(tmp_path)
    for index, frame in enumerate(content["frames"]):
        frame.update(w=WIDTH if index % 2 else 24, h=HEIGHT, cx=WIDTH / 2, cy=HEIGHT / 2)
    save(tmp_path, content)
    data = load(tmp_path)
    assert {camera.width for camera in data.cameras} == {24, WIDTH} and share_of_colors_found(data) > 0.8


@pytest.mark.parametrize("lens", [{}, {"camera_model": "OPENCV", "k1": 0.01}])
def test_images_smaller_than_stated(tmp_path, lens):
    content = write(tmp_path, **lens)
    full = load(tmp_path, downscale=2)
    for frame in content["frames"]:
        image = cv2.imread(str(tmp_path / frame["file_path"]))
        assert image is not None
        (tmp_path / "images_2").mkdir(exist_ok=True)
        small = cv2.resize(image, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(tmp_path / "images_2" / frame["file_path"]), small)
        (tmp_path / frame["file_path"]).unlink()
    data = load(tmp_path)
    assert torch.equal(data[1].camera.K, full[1].camera.K) and data[1].image.shape == full[1].image.shape
    assert any("images are 20 x 15 pixels, the cameras 40 x 30 pixels" in note for note in data.notes)
    save(tmp_path, {**content, "h": HEIGHT + 10})
    assert "h is 40, but the images are 20 x 15 pixels" in message(tmp_path) or "w is 40" in message(tmp_path)


def test_masks_of_frames(tmp_path):
    content = write(tmp_path)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :9] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    content["frames"][0]["mask_path"] = "mask.png"
    save(tmp_path, content)
    data = load(tmp_path)
    assert torch.equal(data[0].mask, torch.from_numpy(mask > 0)) and data[1].mask is None
    assert not load(tmp_path, downscale=2)[0].mask[:, :5].any()
    cv2.imwrite(str(tmp_path / "mask.png"), mask[:10])
    assert "its mask is 40 x 10" in message(tmp_path)
    cv2.imwrite(str(tmp_path / "mask.png"), 0 * mask)
    assert "all black" in message(tmp_path)


FAULTS = {
    "distortion": (lambda content: content.__setitem__("k1", "much"), "k1 is 'much', not a number"),
    "a frame's distortion": (lambda content: content["frames"][3].__setitem__("p2", "no"), "p2 is 'no'"),
    "k5": (lambda content: content.__setitem__("k5", 0.1), "k5 is 0.1, a lens distortion that camera_model None does"),
    "tangential fisheye": (
        lambda content: content.update({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}),
        "p1 is 0.1, a lens distortion that camera_model OPENCV_FISHEYE does not have",
    ),
    "parameters": (lambda content: content.__setitem__("distortion_params", [0] * 7), "distortion_params is [0, 0, 0"),
    "parameter": (lambda content: content["frames"][1].__setitem__("distortion_params", 0.1), "distortion_params is 0"),
    "huge": (lambda content: content.__setitem__("k1", 1e10), "frames[0]: camera parameters are not finite"),
    "huge focal": (lambda content: content.__setitem__("fl_x", 1e300), "its camera has numbers beyond 1e+30"),
    "listed": (lambda content: content.__setitem__("distortion_params", [0, "a"]), "distortion_params (k2) is 'a'"),
    "sphere": (
        lambda content: content["frames"][3].__setitem__("camera_model", "EQUIRECTANGULAR"),
        "'EQUIRECTANGULAR'",
    ),
    "no text": (lambda content: content.__setitem__("camera_model", 3), "camera_model is '3'"),
    "no points": (lambda content: content.__setitem__("ply_file_path", "none.ply"), "none.ply: no such file"),
    "points": (lambda content: content.__setitem__("ply_file_path", 3), "ply_file_path is not text"),
    "mask": (lambda content: content["frames"][0].__setitem__("mask_path", 3), "frames[0].mask_path"),
    "no mask": (lambda content: content["frames"][0].__setitem__("mask_path", "no.png"), "no.png: no such image"),
    "transform": (lambda content: content.__setitem__("applied_transform", [[1, 2]]), "applied_transform must be"),
    "scale": (lambda content: content.__setitem__("applied_scale", -1), "applied_scale a positive"),
    "focal": (lambda content: content.pop("fl_x"), "fl_x"),
    "shares": (
        lambda content: [content.update(fl_x=1.2, cx=0.5, cy=0.5), content.pop("w"), content.pop("h")],
        "frame 0 has fl_x 1.2, cx 0.5 and cy 0.5, shares of the images' size; give them for images of 40 x 30 pixels",
    ),
    "larger images": (
        lambda content: [content.update(fl_x=100.0, cx=40.0, cy=30.0), content.pop("w"), content.pop("h")],
        "has cx 40 and cy 30, the lower right corner of images of 40 x 30 pixels; give the intrinsics of",
    ),
    "time": (lambda content: content["frames"][0].__setitem__("time", "3"), "frames[0].time is '3', not a number"),
    "split": (lambda content: content.__setitem__("train_filenames", []), "train_filenames is empty"),
    "pose": (lambda content: content["frames"][0].__setitem__("transform_matrix", [[1]]), "frames[0].transform_matrix"),
}


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "perspective", "SIMPLE_RADIAL", None])
def test_models_of_a_pinhole_are_read(tmp_path, model):
    content = write(tmp_path, camera_model=model, distortion_params=[0.0] * 6, k5=0, k6=0.0)
    content["frames"][0]["camera_model"] = model
    save(tmp_path, content)
    assert len(load(tmp_path)) == 18


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_named(name, tmp_path):
    content = write(tmp_path, 6)
    change, expected = FAULTS[name]
    change(content)
    save(tmp_path, content)
    text = message(tmp_path)
    assert expected in text and str(tmp_path) in text
