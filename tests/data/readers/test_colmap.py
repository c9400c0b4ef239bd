"""COLMAP's layout: camera models, names, times, sizes, faults."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.data_faults import gone, message, noise, text
from helpers.layouts import (
    COLORS,
    HEIGHT,
    POINTS,
    WIDTH,
    K,
    save_image,
    share_found,
    viewmat,
    write_colmap,
)
from scgs_warp.data import load
from scgs_warp.errors import UserError

FOUND = 0.75
"""Share of the points whose colour is at their pixel; the others hide."""


def test_the_measure_notices_three_pixels(tmp_path):
    write_colmap(tmp_path)
    data = load(tmp_path)
    for entry in data.entries:
        entry.camera.K[0, 2] += 3
    assert share_found(data) < 0.2


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


def test_a_scene_far_from_the_origin(tmp_path):
    """As georeferenced models are: in float32 the cameras' places would be off by a tenth of their distance."""
    far = np.array([4.2e6, -1.7e5, 4.78e6])
    write_colmap(tmp_path, text=True, origin=far)
    for split in ("train", "test"):
        data = load(tmp_path, split)
        views = torch.stack([camera.viewmat for camera in data.cameras]).double().numpy()
        true = np.stack([viewmat(int(frame.name[6:]) - 1) for frame in data])
        shift = np.einsum("vij,vj->vi", true[:, :3, :3].transpose(0, 2, 1), views[:, :3, 3] - true[:, :3, 3])
        assert np.ptp(shift, axis=0).max() < 1e-5, "all cameras are moved by the same"
        np.testing.assert_allclose(data.points.double().numpy() + shift[0], POINTS, atol=1e-5)
        assert any("is subtracted from all cameras and points" in line for line in data.notes)
        x, y, z = (float(word) for word in data.notes[-1].split("(")[1].split(")")[0].split(","))
        np.testing.assert_allclose(far - (x, y, z), -shift[0], atol=1e-4)


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
    with pytest.raises(UserError, match=r"the images of 3 of 5 frames are missing .* pass --min-frames 2"):
        load(folder)
    with pytest.raises(UserError, match=r"camera \d+, of \d+\.jpg, is of 269\d x 20\d\d pixels, but the image is 2704"):
        load(folder, min_frames=2)


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


def model_text(file: str, edit):
    def fault(folder: Path) -> None:
        path = folder / "sparse/0" / file
        path.write_text("".join(edit(path.read_text().splitlines(keepends=True))))

    return fault


def words(line: int, place: int, value: str):
    def edit(lines: list[str]) -> list[str]:
        data = [index for index, content in enumerate(lines) if not content.startswith("#")][line]
        parts = lines[data].split()
        parts[place] = value
        lines[data] = " ".join(parts) + "\n"
        return lines

    return edit


FAULTS = {
    "nan": (model_text("images.txt", words(0, 2, "nan")), "images.txt: the pose of 'frame_1.png'"),
    "quaternion": (model_text("images.txt", words(0, 2, "7.0")), "images.txt: the pose of 'frame_1.png'"),
    "no number": (model_text("images.txt", words(0, 2, "x")), "images.txt: truncated or damaged"),
    "camera": (model_text("images.txt", words(0, 8, "3")), "frame_1.png is of camera 3, which cameras.txt does"),
    "outside": (
        model_text("images.txt", words(0, 9, "../f.png")),
        "name of an image is '../f.png', which leads out",
    ),
    "truncated": (model_text("images.txt", lambda lines: lines[:-1]), "its line of observations is missing"),
    "empty": (text("sparse/0/images.txt", "# nothing\n"), "no image is registered"),
    "model": (model_text("cameras.txt", words(0, 1, "PLATE")), "camera '7' is of no model that is known"),
    "params": (model_text("cameras.txt", words(0, 1, "OPENCV")), "camera '7' has 4 parameters, but OPENCV"),
    "focal": (model_text("cameras.txt", words(0, 4, "-3")), "the focal length is not positive"),
    "no size": (model_text("cameras.txt", words(0, 2, "0")), "is of 0 x 60 pixels, but the image is 80 x 60"),
    "size": (model_text("cameras.txt", words(0, 2, "81")), "is of 81 x 60 pixels, but the image is 80 x 60"),
    "binary": (lambda folder: (folder / "sparse/0/images.txt").write_bytes(b"\xff\xfe\x80"), "truncated or damaged"),
    "points": (model_text("points3D.txt", words(0, 2, "far")), "points3D.txt: truncated or damaged"),
    "no images": (gone("images"), "the images of 14 of 14 frames are missing (frame_1.png, frame_2.png, frame_3.png"),
    "undecodable": (noise("images/frame_3.png"), "frame_3.png: not an image"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named(tmp_path, fault):
    edit, expected = FAULTS[fault]
    write_colmap(tmp_path, text=True)
    edit(tmp_path)
    assert expected in message(tmp_path)


def bare(content: bytes) -> bytes:
    """Without lines of observations, as editors and scripts that drop empty lines leave it."""
    rows = [row for row in content.split(b"\n") if not row.startswith(b"#")]
    return b"\n".join(rows[::2])


EDITS = {
    "no observations": ("images.txt", bare),
    "windows": ("images.txt", lambda content: b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n")),
    "byte order mark": ("cameras.txt", lambda content: b"\xef\xbb\xbf" + content),
}


@pytest.mark.parametrize("edit", EDITS)
def test_text_as_editors_and_scripts_leave_it(tmp_path, edit):
    write_colmap(tmp_path, text=True)
    name, change = EDITS[edit]
    file = tmp_path / "sparse/0" / name
    file.write_bytes(change(file.read_bytes()))
    train = load(tmp_path)
    assert len(train) == 12 and share_found(train, 0.02) > FOUND


def test_names_may_differ_in_case(tmp_path):
    write_colmap(tmp_path)
    (tmp_path / "images/frame_3.png").rename(tmp_path / "images/Frame_3.PNG")
    assert len(load(tmp_path)) == 12


def test_one_frame_cannot_be_split(tmp_path):
    write_colmap(tmp_path, count=1)
    assert "one frame cannot be both" in message(tmp_path)
