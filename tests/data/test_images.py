"""Images of a data set: composited once, reduced, decoded in threads; truncated files are refused."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch
from PIL import Image as PillowImage

from helpers.dnerf_files import HEIGHT, WIDTH, write_scene
from scgs_warp.data import images, load
from scgs_warp.errors import UserError


@pytest.mark.parametrize("background", ["black", "white", "random"])
def test_composited_once(tmp_path, background):
    written = write_scene(tmp_path / "s", frames=1)
    data = load(tmp_path / "s", "train", background=background)
    frame = data[0]
    rgba = torch.from_numpy(written[0]).double() / 255
    color = 1.0 if background == "white" else 0.0
    expected = rgba[..., :3] * rgba[..., 3:] + color * (1 - rgba[..., 3:])
    assert frame.image.dtype == torch.float32 and frame.image.permute(2, 0, 1).is_contiguous()
    assert (frame.image - expected).abs().max() < 1e-6
    assert frame.alpha is not None and (frame.alpha - rgba[..., 3]).abs().max() < 1e-6
    assert data.background == background and data.background_color.tolist() == [color] * 3


def test_alpha_that_says_nothing_is_none(tmp_path):
    """A file that an object fills keeps its alpha as long as others have something to say."""
    folder = tmp_path / "s"
    written = write_scene(folder, frames=2)
    for index, image in enumerate(written):
        image[..., 3] = 255
        PillowImage.fromarray(image).save(folder / f"train/r_{index:03d}.png")
        alphas = [frame.alpha for frame in load(folder, "train")]
        assert all(alpha is not None for alpha in alphas) == (index == 0), "all or none"
    assert alphas == [None, None]


def test_area_averages_premultiplied(tmp_path):
    written = write_scene(tmp_path / "s", frames=1)
    frame = load(tmp_path / "s", "train", downscale=2, background="white")[0]
    rgba = torch.from_numpy(written[0]).double() / 255
    composited = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])
    expected = composited.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((1, 3))
    assert (frame.image - expected).abs().max() < 1e-6
    assert frame.image.permute(2, 0, 1).is_contiguous()
    focal = 0.25 * WIDTH / math.tan(0.4)
    assert torch.allclose(frame.camera.K, torch.tensor([[focal, 0, WIDTH / 4], [0, focal, HEIGHT / 4], [0, 0, 1]]))


def test_bicubic_is_pillows(tmp_path):
    written = write_scene(tmp_path / "s", frames=1)
    frame = load(tmp_path / "s", "train", downscale=2, resample="bicubic", background="white")[0]
    rgba = written[0] / 255.0
    composited = ((rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])) * 255).astype(np.uint8)
    reduced = np.asarray(PillowImage.fromarray(composited).resize((WIDTH // 2, HEIGHT // 2))) / 255.0
    assert np.abs(frame.image.numpy() - reduced).max() < 1e-6
    alpha = np.asarray(PillowImage.fromarray(written[0][..., 3]).resize((WIDTH // 2, HEIGHT // 2))) / 255.0
    assert frame.alpha is not None and np.abs(frame.alpha.numpy() - alpha).max() < 1e-6


def test_uneven_downscale_scales_each_axis(tmp_path):
    write_scene(tmp_path / "s", frames=1)
    camera = load(tmp_path / "s", "train", downscale=1.7)[0].camera
    assert (camera.width, camera.height) == (14, 9)
    focal = 0.5 * WIDTH / math.tan(0.4)
    assert camera.K[0, 0] == pytest.approx(focal * 14 / WIDTH) and camera.K[1, 1] == pytest.approx(focal * 9 / HEIGHT)


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


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_truncated_images_are_told(tmp_path, suffix):
    image = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    data = cv2.imencode(suffix, image)[1].tobytes()
    path = tmp_path / f"a{suffix}"
    path.write_bytes(data)
    assert images.decode(path).shape == (40, 60, 3)
    assert images.is_complete(np.frombuffer(data + b"appended", np.uint8))
    for share in (0.0, 0.1, 0.5, 0.99):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(UserError, match=rf"a\{suffix}: not an image"):
            images.decode(path)
        if suffix == ".jpg":
            assert not images.is_complete(np.fromfile(path, np.uint8))


@pytest.mark.parametrize("options", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]])
def test_a_film_may_follow_a_photo(options):
    """Motion photos: the film's bytes hold any marker, in any order."""
    image = np.random.default_rng(0).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    data = cv2.imencode(".jpg", image, options)[1].tobytes()
    thumbnail = b"\xff\xd8\xff\xda\x00\x02\xff\xd9"
    data = data[:2] + b"\xff\xff\xe1" + (2 + len(thumbnail)).to_bytes(2, "big") + thumbnail + data[2:]
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape == image.shape
    for film in (b"\xff\xda\x00", b"\xff\xd9\xff\xda", b"\xff"):
        assert images.is_complete(np.frombuffer(data + film, np.uint8))
    for end in (1, 2, 20, len(data) - len(thumbnail)):
        assert not images.is_complete(np.frombuffer(data[:-end], np.uint8))


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_files_that_are_cut_out(kind):
    """Programs that resize images leave single pixels that are not quite opaque."""
    white = np.iinfo(kind).max
    pixels = np.full((100, 100, 4), white, kind)
    assert not images.is_transparent(pixels) and not images.is_transparent(pixels[..., :3])
    pixels[..., 3] = round(0.997 * white)
    pixels[0, :10, 3] = 0
    assert not images.is_transparent(pixels)
    pixels[0, 10, 3] = white // 2
    assert images.is_transparent(pixels)


def palette_mask(file, classes: np.ndarray, colors: list[int]) -> None:
    image = PillowImage.fromarray(classes, "P")
    image.putpalette(colors)
    image.save(file)


def test_masks_in_alpha_and_in_palettes(tmp_path):
    """Without black, the first colour of a palette takes its place; of white masks with alpha, what is transparent."""
    true = np.array([[False, True, True], [True, False, True]])
    file, white, alpha = tmp_path / "mask.png", np.full(true.shape, 255, np.uint8), true.astype(np.uint8) * 255
    kinds = {
        "LA": lambda: PillowImage.fromarray(np.dstack([white, alpha])).save(file),
        "RGBA": lambda: PillowImage.fromarray(np.dstack([white] * 3 + [alpha])).save(file),
        "palette": lambda: palette_mask(file, true.astype(np.uint8), [128, 0, 0, 0, 128, 0]),
        "palette of nothing": lambda: palette_mask(file, true.astype(np.uint8), [0, 0, 0]),
        "palette with black": lambda: palette_mask(file, 1 - true.astype(np.uint8), [9, 9, 9, 0, 0, 0]),
        "colours beside opaque alpha": lambda: PillowImage.fromarray(np.dstack([alpha] * 3 + [white])).save(file),
    }
    for kind, write in kinds.items():
        write()
        np.testing.assert_array_equal(images.read_mask(file, tmp_path / "image.png", (3, 2)), true, err_msg=kind)
    palette_mask(file, np.full(true.shape, 1, np.uint8), [128, 0, 0, 0, 128, 0])
    assert images.read_mask(file, tmp_path / "image.png", (3, 2)).all()
    PillowImage.fromarray(np.dstack([0 * white] * 3 + [alpha])).save(file)
    with pytest.raises(UserError, match=r"mask\.png: masks differ in their alpha channel only"):
        images.read_mask(file, tmp_path / "image.png", (3, 2))


def test_a_mask_hides_what_is_black(tmp_path):
    """The darkest grey is valid already, and so is a pixel of a single colour."""
    mask = np.array([[[0, 0, 0], [1, 1, 1], [0, 0, 2]], [[127, 127, 127], [255, 255, 255], [0, 0, 0]]], np.uint8)
    PillowImage.fromarray(mask).save(tmp_path / "mask.png")
    found = images.read_mask(tmp_path / "mask.png", tmp_path / "image.png", (3, 2))
    assert found.tolist() == [[False, True, True], [True, True, False]]
