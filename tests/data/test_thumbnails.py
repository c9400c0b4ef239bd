"""Thumbnails tell images of equal names apart, but not two decodings of one image."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from helpers.nerfstudio_files import write
from helpers.tiny import tiny_dataset
from scgs_warp.data import load
from scgs_warp.data.dataset import Dataset
from scgs_warp.data.thumbnails import IMAGES, SIDE, thumbnails
from scgs_warp.storage.recorded_images import differ


def other(change) -> str:
    """Thumbnails of a data set whose images are changed."""
    data = tiny_dataset(12)
    frames = [dataclasses.replace(frame, image=change(frame.image)) for frame in data]
    return thumbnails(Dataset(frames, folder=data.folder, split="train"))


SAME = thumbnails(tiny_dataset(12))


def test_a_few_images_are_recorded():
    assert len(bytes.fromhex(SAME)) == IMAGES * 3 * SIDE * SIDE
    assert len(bytes.fromhex(thumbnails(tiny_dataset(2)))) == 2 * 3 * SIDE * SIDE


@pytest.mark.parametrize("change", [lambda image: image.flip(1), lambda image: 1.0 - image, lambda image: image * 0.9])
def test_other_images_differ(change):
    assert differ(SAME, other(change))


@pytest.mark.parametrize("change", [lambda image: image + 0.008, lambda image: image + 0.01 * torch.randn(48, 48, 3)])
def test_the_same_images_decoded_otherwise_do_not(change):
    assert not differ(SAME, other(change))


@pytest.mark.parametrize("recorded", [None, "", "no digits", 5, {}])
def test_without_a_record_nothing_differs(recorded):
    assert not differ(recorded, SAME)


@pytest.mark.parametrize(("width", "height"), [(1, 20), (3, 5), (1, 1)])
def test_small_images(width, height):
    data = tiny_dataset(1)
    frame = dataclasses.replace(data[0], image=torch.full((height, width, 3), 0.5), alpha=None)
    assert set(bytes.fromhex(thumbnails(Dataset([frame], folder=data.folder, split="train")))) == {128}


def test_an_image_that_is_gone_leaves_nothing_to_compare(tmp_path):
    write(tmp_path)
    data = load(tmp_path, cache_mib=0)
    (tmp_path / "f_0.png").unlink()
    assert thumbnails(data) == "" and not differ(SAME, "")


def test_an_image_that_is_not_finite_has_no_thumbnail():
    data = tiny_dataset(1)
    frame = dataclasses.replace(data[0], image=torch.full((4, 4, 3), float("nan")), alpha=None)
    assert thumbnails(Dataset([frame], folder=data.folder, split="train")) == ""
