"""Masks that the user gives."""

from __future__ import annotations

import weakref
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from helpers.films import mask_images
from scgs_warp.capture import given_masks
from scgs_warp.capture.source import Folder, Video
from scgs_warp.errors import UserError
from scgs_warp.visualization.video import film

SIZE = (160, 120)
NAMES = [f"{index:03d}.png" for index in range(4)]


def read(*arguments) -> list[np.ndarray]:
    return list(given_masks.read_masks(*arguments))


def test_given_masks_belong_to_frames_by_name_order_or_number(tmp_path):
    frames = mask_images(tmp_path / "frames", 12, (320, 240))
    masks = mask_images(tmp_path / "masks", 12)
    names = [f"{index:03d}.png" for index in (2, 7)]
    by_name = read(masks, Folder(frames), [2, 7], names, (320, 240))
    assert by_name[0][20:60, 20:60].all() and by_name[1][20:60, 70:110].all()
    assert [mask.sum() for mask in by_name] == [1600, 1600]
    with film(tmp_path / "frames.mp4") as out:
        for file in sorted(frames.iterdir()):
            out.write(cv2.imread(str(file)))
    video = Video(tmp_path / "frames.mp4")
    by_order = read(masks, video, [2, 7], ["", ""], (320, 240))
    by_film = read(tmp_path / "frames.mp4", video, [2, 7], ["", ""], (320, 240))
    few = mask_images(tmp_path / "few", 8, name="frame_{:05d}.png")
    by_number = read(few, video, [2, 7], ["", ""], (320, 240))
    for found in (by_order, by_number):
        assert all(np.array_equal(a, b) for a, b in zip(by_name, found))
    for index, mask in zip((2, 7), by_film):
        assert mask[11:29, 5 * index + 1 : 5 * index + 19].all() and mask.sum() < 500


def test_masks_that_do_not_fit_are_refused(tmp_path):
    frames, masks = Folder(mask_images(tmp_path / "frames", 12)), mask_images(tmp_path / "masks", 6)
    with pytest.raises(UserError, match=r"masks: no mask for 007 \(1 of 2"):
        read(masks, frames, [2, 7], ["002.png", "007.png"], (160, 120))
    with pytest.raises(UserError, match="proportions"):
        read(masks, frames, [2], ["002.png"], (160, 160))
    with film(tmp_path / "short.mp4") as out:
        for _ in range(4):
            out.write(np.zeros((120, 160, 3), np.uint8))
    with pytest.raises(UserError, match="ends before frame 7"):
        read(tmp_path / "short.mp4", frames, [2, 7], ["", ""], (160, 120))


def masks_of(folder: Path, convert, suffix: str = ".png") -> list[np.ndarray]:
    """Masks of four frames, each converted from [H, W] bool that is True where nothing moves."""
    frames = folder.with_name("frames")
    if not frames.exists():
        mask_images(frames, 4)
    folder.mkdir()
    for name in NAMES:
        still = cv2.imread(str(frames / name), cv2.IMREAD_GRAYSCALE) > 128
        assert cv2.imwrite(str((folder / name).with_suffix(suffix)), convert(still))
    return read(folder, Folder(frames), range(4), NAMES, SIZE)


def rgba(color: int, alpha: np.ndarray) -> np.ndarray:
    return np.dstack([np.full((*alpha.shape, 3), color, np.uint8), np.where(alpha, 255, 0).astype(np.uint8)])


@pytest.mark.parametrize(
    ("convert", "suffix"),
    [
        (lambda still: still.astype(np.uint8), ".png"),
        (lambda still: np.dstack([still.astype(np.uint8)] * 3), ".bmp"),
        (lambda still: still.astype(np.uint16), ".png"),
        (lambda still: still.astype(np.uint16) * 255, ".png"),
        (lambda still: still.astype(np.uint16) * 65535, ".png"),
        (lambda still: still.astype(np.float32), ".tif"),
        (lambda still: rgba(255, still), ".png"),
        (lambda still: np.dstack([rgba(0, still)[..., 3]] * 3 + [np.full(still.shape, 255, np.uint8)]), ".png"),
    ],
    ids=["0/1", "0/1 in colour", "0/1 of 16 bits", "0/255 of 16 bits", "16 bits", "floats", "alpha", "opaque"],
)
def test_masks_mean_the_same_however_programs_write_them(tmp_path, convert, suffix):
    expected = masks_of(tmp_path / "masks", lambda still: still.astype(np.uint8) * 255)
    assert all(mask.sum() == 400 for mask in expected)
    assert np.array_equal(masks_of(tmp_path / "others", convert, suffix), expected)


def test_masks_with_a_palette_are_read_by_the_order_of_its_colours(tmp_path):
    expected = masks_of(tmp_path / "masks", lambda still: still.astype(np.uint8) * 255)
    for name in NAMES:
        still = cv2.imread(str(tmp_path / "masks" / name), cv2.IMREAD_GRAYSCALE) > 128
        image = Image.fromarray(still.astype(np.uint8), "P")
        image.putpalette([200, 200, 200, 40, 60, 20])
        image.save(tmp_path / "masks" / name)
    assert np.array_equal(read(tmp_path / "masks", Folder(tmp_path / "frames"), range(4), NAMES, SIZE), expected)


def test_what_masks_mean_is_decided_for_all_alike(tmp_path):
    """A single one of 0 and 255 tells that a mask of 0 and 1 is black."""
    masks_of(tmp_path / "masks", lambda still: still.astype(np.uint8))
    cv2.imwrite(str(tmp_path / "masks/003.png"), np.full((120, 160), 255, np.uint8))
    found = read(tmp_path / "masks", Folder(tmp_path / "frames"), range(4), NAMES, SIZE)
    assert [float(mask.mean()) for mask in found] == [1, 1, 1, 0]


@pytest.mark.parametrize(
    ("convert", "said"),
    [
        (lambda still: still * np.uint8(0), "hide everything, because their largest value is 0; save them with 255"),
        (lambda still: still * np.uint8(7), "their largest value is 7"),
        (lambda still: still * np.uint16(4095), "their largest value is 4095; save them with 65535"),
        (lambda still: rgba(0, still), "differ in their alpha channel only"),
    ],
)
def test_masks_that_hide_everything_or_may_mean_either_are_refused(tmp_path, convert, said):
    with pytest.raises(UserError, match=f"masks: masks {'' if 'alpha' in said else '.*'}{said}"):
        masks_of(tmp_path / "masks", convert)


def test_a_film_of_masks_that_hides_everything_is_refused(tmp_path):
    with film(tmp_path / "masks.mp4") as out:
        for _ in range(4):
            out.write(np.zeros((120, 160, 3), np.uint8))
    with pytest.raises(UserError, match=r"masks\.mp4: masks hide everything.*invert"):
        read(tmp_path / "masks.mp4", Folder(mask_images(tmp_path / "frames", 4)), range(4), NAMES, SIZE)


def test_masks_are_read_one_at_a_time(tmp_path, monkeypatch):
    """A full-size mask is gone before the one after the next is read."""
    mask_images(tmp_path / "frames", 40)
    alive: list[weakref.ref] = []
    inner = given_masks.read_rgb

    def watched(file: Path) -> np.ndarray:
        assert sum(made() is not None for made in alive) <= 1
        image = inner(file)
        alive.append(weakref.ref(image))
        return image

    monkeypatch.setattr(given_masks, "read_rgb", watched)
    names = [f"{index:03d}.png" for index in range(20)]
    frames = Folder(tmp_path / "frames")
    assert sum(1 for _ in given_masks.read_masks(tmp_path / "frames", frames, range(20), names, SIZE)) == 20
    assert len(alive) == 20
