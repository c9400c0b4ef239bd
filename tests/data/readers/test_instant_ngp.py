"""What instant-ngp, and apps that write for it, add to ``transforms.json``: depth of their own names, time stamps."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.nerfstudio_files import HEIGHT, WIDTH, save, write
from scgs_warp.data import load
from scgs_warp.errors import UserError

SCALE = 4.0 / 65535.0
"""Metres of a value, as nerfcapture2nerf.py writes it."""


def with_depth(folder: Path, **changes) -> dict:
    """A data set of which every frame names a map of 3 m in ``depth_path``."""
    content = write(folder, integer_depth_scale=SCALE, **changes)
    cv2.imwrite(str(folder / "0.depth.png"), np.full((HEIGHT, WIDTH), round(3.0 / SCALE), np.uint16))
    for entry in content["frames"]:
        entry["depth_path"] = "0.depth.png"
    save(folder, content)
    return content


def test_depth_of_instant_ngp(tmp_path):
    content = with_depth(tmp_path)
    data = load(tmp_path)
    assert data.with_depth == list(range(len(data)))
    depth = data.depth(0)
    assert depth is not None
    np.testing.assert_allclose(depth.numpy(), 3.0, atol=1e-3)
    content["frames"][0]["depth_path"] = "9.depth.png"
    save(tmp_path, content)
    assert "1 of 18 depth maps are missing" in load(tmp_path).notes[-1]
    content["frames"][0]["depth_path"] = 3
    save(tmp_path, content)
    with pytest.raises(UserError, match=r"frames\[0\].depth_path is not text"):
        load(tmp_path)
    with_depth(tmp_path)
    save(tmp_path, {**with_depth(tmp_path), "integer_depth_scale": 0})
    with pytest.raises(UserError, match="integer_depth_scale is no positive number"):
        load(tmp_path)


def test_depth_that_instant_ngp_leaves_out(tmp_path):
    """It reads none without a unit, nor if ``enable_depth_loading`` is false; nerfstudio's own maps come first."""
    content = with_depth(tmp_path)
    save(tmp_path, {**content, "enable_depth_loading": False})
    assert load(tmp_path).with_depth == []
    save(tmp_path, {key: value for key, value in content.items() if key != "integer_depth_scale"})
    assert load(tmp_path).with_depth == [] and not load(tmp_path).notes
    cv2.imwrite(str(tmp_path / "own.png"), np.full((HEIGHT, WIDTH), 5000, np.uint16))
    for entry in content["frames"]:
        entry["depth_file_path"] = "own.png"
    save(tmp_path, content)
    depth = load(tmp_path).depth(0)
    assert depth is not None
    np.testing.assert_allclose(depth.numpy(), 5.0)


def test_time_stamps_of_one_camera(tmp_path):
    """NeRFCapture writes when each picture was taken, in seconds, but lists pictures as its threads end."""
    content = write(tmp_path)
    stamps = [5000.25 + index + 10 * (index > 15) for index in range(20)]
    for entry, stamp in zip(content["frames"], stamps):
        del entry["time"]
        entry["timestamp"] = stamp
    content["frames"][:2] = content["frames"][1::-1]
    save(tmp_path, content)
    data = load(tmp_path)
    expected = {f"f_{index}": (stamp - stamps[0]) / (stamps[-1] - stamps[0]) for index, stamp in enumerate(stamps)}
    for frame in data:
        assert frame.time == pytest.approx(expected[frame.name], abs=1e-6)
    assert "times from 5000.25 to 5029.25 are scaled" in data.notes[0]


@pytest.mark.parametrize("stamps", [[7.0] * 20, [*range(19), "late"], [*range(19), None]])
def test_time_stamps_that_tell_nothing(tmp_path, stamps):
    content = write(tmp_path)
    for entry, stamp in zip(content["frames"], stamps):
        del entry["time"]
        entry["timestamp"] = stamp
    save(tmp_path, content)
    for index, frame in enumerate(frame for frame in load(tmp_path) if frame.name != "f_0"):
        assert frame.time == pytest.approx(int(frame.name[2:]) / 19, abs=1e-6), index


def test_time_stamps_of_a_rig_do_not_part_its_moments(tmp_path):
    """Cameras that record at once stamp their pictures a little apart."""
    content = write(tmp_path)
    for index, entry in enumerate(content["frames"]):
        place = tmp_path / f"cam{index % 2}"
        place.mkdir(exist_ok=True)
        (tmp_path / entry["file_path"]).rename(place / f"{index // 2}.png")
        del entry["time"]
        entry |= {"file_path": f"cam{index % 2}/{index // 2}.png", "timestamp": index // 2 + 0.001 * (index % 2)}
    save(tmp_path, content)
    assert len(set(load(tmp_path).times.tolist())) == 10
