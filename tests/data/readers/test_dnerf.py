"""The D-NeRF reader: what it reads, how it composites and reduces, and what it says about bad input."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image as PillowImage

from scgs_warp.data import load
from scgs_warp.errors import UserError
from scgs_warp.geometry.normalisation import Normalisation

WIDTH, HEIGHT = 24, 16
IDENTITY = [[1, 0, 0, 0.5], [0, 1, 0, 0.25], [0, 0, 1, 4], [0, 0, 0, 1]]


def write_scene(folder: Path, frames: int = 3, mode: str = "RGBA", seed: int = 0, **fields) -> list[np.ndarray]:
    """A tiny valid data set of random pixels; returns the images."""
    rng = np.random.default_rng(seed)
    (folder / "train").mkdir(parents=True)
    images, entries = [], []
    for index in range(frames):
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH, len(mode)), dtype=np.uint8)
        PillowImage.fromarray(pixels).save(folder / f"train/r_{index:03d}.png")
        images.append(pixels)
        time = index / max(frames - 1, 1)
        entries.append({"file_path": f"./train/r_{index:03d}", "time": time, "transform_matrix": IDENTITY})
    content = {"camera_angle_x": 0.8, "frames": entries, **fields}
    (folder / "transforms_train.json").write_text(json.dumps(content))
    return images


HUGE = "a number of 5,000 digits"
"""Python refuses to read such a number, and to write it."""


def edit(folder: Path, change) -> None:
    path = folder / "transforms_train.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content).replace(f'"{HUGE}"', "9" * 5_000))


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


@pytest.mark.parametrize("background", ["black", "white", "random"])
def test_composited_once(tmp_path, background):
    images = write_scene(tmp_path / "s", frames=1)
    data = load(tmp_path / "s", "train", background=background)
    frame = data[0]
    rgba = torch.from_numpy(images[0]).double() / 255
    color = 1.0 if background == "white" else 0.0
    expected = rgba[..., :3] * rgba[..., 3:] + color * (1 - rgba[..., 3:])
    assert frame.image.dtype == torch.float32 and frame.image.permute(2, 0, 1).is_contiguous()
    assert (frame.image - expected).abs().max() < 1e-6
    assert frame.alpha is not None and (frame.alpha - rgba[..., 3]).abs().max() < 1e-6
    assert data.background == background and data.background_color.tolist() == [color] * 3


def test_alpha_that_says_nothing_is_none(tmp_path):
    """A file that an object fills keeps its alpha as long as others have something to say."""
    folder = tmp_path / "s"
    images = write_scene(folder, frames=2)
    for index, image in enumerate(images):
        image[..., 3] = 255
        PillowImage.fromarray(image).save(folder / f"train/r_{index:03d}.png")
        alphas = [frame.alpha for frame in load(folder, "train")]
        assert all(alpha is not None for alpha in alphas) == (index == 0), "all or none"
    assert alphas == [None, None]


def test_area_averages_premultiplied(tmp_path):
    images = write_scene(tmp_path / "s", frames=1)
    frame = load(tmp_path / "s", "train", downscale=2, background="white")[0]
    rgba = torch.from_numpy(images[0]).double() / 255
    composited = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])
    expected = composited.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((1, 3))
    assert (frame.image - expected).abs().max() < 1e-6
    assert frame.image.permute(2, 0, 1).is_contiguous()
    focal = 0.25 * WIDTH / math.tan(0.4)
    assert torch.allclose(frame.camera.K, torch.tensor([[focal, 0, WIDTH / 4], [0, focal, HEIGHT / 4], [0, 0, 1]]))


def test_bicubic_is_pillows(tmp_path):
    images = write_scene(tmp_path / "s", frames=1)
    frame = load(tmp_path / "s", "train", downscale=2, resample="bicubic", background="white")[0]
    rgba = images[0] / 255.0
    composited = ((rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])) * 255).astype(np.uint8)
    reduced = np.asarray(PillowImage.fromarray(composited).resize((WIDTH // 2, HEIGHT // 2))) / 255.0
    assert np.abs(frame.image.numpy() - reduced).max() < 1e-6
    alpha = np.asarray(PillowImage.fromarray(images[0][..., 3]).resize((WIDTH // 2, HEIGHT // 2))) / 255.0
    assert frame.alpha is not None and np.abs(frame.alpha.numpy() - alpha).max() < 1e-6


def test_uneven_downscale_scales_each_axis(tmp_path):
    write_scene(tmp_path / "s", frames=1)
    camera = load(tmp_path / "s", "train", downscale=1.7)[0].camera
    assert (camera.width, camera.height) == (14, 9)
    focal = 0.5 * WIDTH / math.tan(0.4)
    assert camera.K[0, 0] == pytest.approx(focal * 14 / WIDTH) and camera.K[1, 1] == pytest.approx(focal * 9 / HEIGHT)


def test_pixel_intrinsics_and_index_times(tmp_path):
    write_scene(tmp_path / "s", frames=3, mode="RGB", fl_x=30.0, fl_y=31.0, cx=11.0, cy=7.5, w=WIDTH, h=HEIGHT)
    edit(tmp_path / "s", lambda content: [frame.pop("time") for frame in content["frames"]])
    data = load(tmp_path / "s", "train", background="random")
    assert data[1].camera.K.tolist() == [[30.0, 0.0, 11.0], [0.0, 31.0, 7.5], [0.0, 0.0, 1.0]]
    assert data.times.tolist() == [0.0, 0.5, 1.0] and data[0].alpha is None


def test_progress_and_threads_change_nothing(tmp_path, all_threads):
    from scgs_warp.runtime import environment

    write_scene(tmp_path / "s", frames=5)
    seen = []
    environment.configure(threads=1)
    one = load(tmp_path / "s", "train", progress=lambda done, total: seen.append((done, total)))
    environment.configure(threads=2)
    two = load(tmp_path / "s", "train")
    assert seen == [(index, 5) for index in range(1, 6)]
    assert all(torch.equal(a.image, b.image) for a, b in zip(one, two))


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
    "time beyond": (frame_field("time", 1.5), "frames[1].time is 1.5"),
    "time before": (frame_field("time", -0.1), "frames[1].time is -0.1"),
    "time absent": (lambda content: content["frames"][1].pop("time"), "frames[1].time"),
    "image missing": (frame_field("file_path", "./train/nowhere"), "nowhere.png"),
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
    assert "transforms_train.json" in message(scene)
    write_scene(tmp_path / "t")
    scene = tmp_path / "t"
    assert "transforms_test.json" in message(scene, "test")
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
