"""Data sets: frames are read when they are asked for, indices are spread evenly."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.dycheck_files import write_dycheck
from helpers.nerfstudio_files import write
from helpers.tiny import tiny_camera, tiny_dataset
from scgs_warp.data import load
from scgs_warp.data.dataset import Dataset, neighbors_in_time, spread
from scgs_warp.errors import UserError
from scgs_warp.types import Frame


def test_a_file_that_goes_away_is_told_when_it_is_needed(tmp_path):
    write(tmp_path)
    data = load(tmp_path, cache_mib=0)
    (tmp_path / "f_3.png").unlink()
    assert data[0].image is not None
    with pytest.raises(UserError, match=r"f_3\.png: no such image"):
        _ = data[3].image


@pytest.mark.parametrize(("split", "read"), [("train", Dataset.depth), ("test", Dataset.covisible)])
def test_a_relative_folder_is_read_after_the_directory_has_changed(split, read, tmp_path, monkeypatch):
    write_dycheck(tmp_path / "iphone")
    (tmp_path / "elsewhere").mkdir()
    expected = load(tmp_path / "iphone", split)
    monkeypatch.chdir(tmp_path)
    data = load("iphone", split, cache_mib=0)
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert torch.equal(data[0].image, expected[0].image) and torch.equal(read(data, 0), read(expected, 0))


@pytest.mark.parametrize("bad", [math.nan, math.inf, [1], {}, np.zeros(3), object(), -1])
@pytest.mark.parametrize(
    "option", ["downscale", "resample", "background", "cache_mib", "frames", "only_cameras", "min_frames"]
)
def test_options_of_another_kind_are_named(option, bad, tmp_path):
    with pytest.raises(UserError, match=f"{option.replace('min_frames', '--min-frames')}.* give "):
        load(tmp_path, **{option: bad})


def test_no_frame_is_lost_for_lack_of_a_camera():
    data = tiny_dataset(3)
    for cameras in (data.cameras[:2], data.cameras * 2):
        with pytest.raises(ValueError, match=f"one for each of the 3 frames, got {len(cameras)}"):
            data.with_cameras(cameras)


@pytest.mark.parametrize(("count", "most"), [(0, 24), (1, 24), (24, 24), (25, 24), (47, 24), (1000, 24), (5, 1)])
def test_spread_takes_no_more_than_it_may(count, most):
    chosen = spread(count, most)
    assert len(chosen) == len(set(chosen)) == min(count, most)
    assert chosen == sorted(chosen) and all(0 <= index < count for index in chosen)
    if count and most > 1:
        assert chosen[0] == 0 and chosen[-1] == count - 1


def test_neighbours_are_those_in_time():
    data = tiny_dataset(5)
    assert neighbors_in_time(data).tolist() == [[0, 1], [0, 2], [1, 3], [2, 4], [3, 4]]
    cameras = [tiny_camera(k % 2, 2, 48) for k in range(6)]
    frames = [Frame(cameras[k], (k // 2) / 2, torch.zeros(4, 4, 3), None, None, f"{k}") for k in range(6)]
    rig = Dataset(frames, folder=Path("rig"), split="train")
    assert neighbors_in_time(rig).tolist() == [[0, 2], [1, 3], [0, 4], [1, 5], [2, 4], [3, 5]]


def test_other_data_has_another_fingerprint():
    """Names, times, sizes and the background count; what the images show does not."""
    data = tiny_dataset(3)
    first, *others = data

    def print_of(background: str = "black", **changes) -> str:
        frames = [dataclasses.replace(first, **changes), *others]
        return Dataset(frames, folder=data.folder, split="train", background=background).fingerprint

    camera = first.camera
    same = [data.fingerprint, print_of(image=first.image * 0.5), print_of(alpha=None)]
    different = [
        print_of("white"),
        print_of(time=0.01),
        print_of(name="other"),
        print_of(camera=dataclasses.replace(camera, width=camera.width + 1)),
        print_of(camera=dataclasses.replace(camera, height=camera.height + 1)),
        Dataset(others, folder=data.folder, split="train").fingerprint,
    ]
    assert len(set(same)) == 1 and len({*same, *different}) == 7
