"""OpenEXR files of one number per pixel."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.foreign_scenes import write_exr
from scgs_warp.data.depth_maps import DepthFile, read_depth_map
from scgs_warp.errors import UserError
from scgs_warp.storage import exr_files
from scgs_warp.storage.exr_files import read_exr

OpenEXR = pytest.importorskip("OpenEXR")
DEPTH = np.random.default_rng(5).uniform(1.0, 4.0, (12, 16)).astype(np.float32)


@pytest.mark.parametrize("name", ["Z", "V", "R", "distance"])
@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_the_only_channel_is_read(name, kind, tmp_path):
    write_exr(tmp_path / "a.exr", {name: DEPTH.astype(kind)})
    found = read_exr(tmp_path / "a.exr")
    assert found.dtype == kind and np.array_equal(found, DEPTH.astype(kind))


def test_of_several_channels_that_of_depth_is_read(tmp_path):
    write_exr(tmp_path / "a.exr", {"R": DEPTH + 1, "G": DEPTH + 2, "B": DEPTH + 3, "Z": DEPTH})
    assert np.array_equal(read_exr(tmp_path / "a.exr"), DEPTH)
    for name in ("ViewLayer.Depth.Z", "Depth.V"):
        write_exr(tmp_path / "b.exr", {"ViewLayer.Combined.R": DEPTH + 1, name: DEPTH})
        assert np.array_equal(read_exr(tmp_path / "b.exr"), DEPTH)


def test_the_depth_may_be_in_another_part(tmp_path):
    parts = [({"R": DEPTH + 1, "G": DEPTH + 2, "B": DEPTH + 3}, "beauty"), ({"Z": DEPTH}, "depth")]
    made = [OpenEXR.Part({"type": OpenEXR.scanlineimage}, channels, name) for channels, name in parts]
    OpenEXR.File(made).write(str(tmp_path / "a.exr"))
    assert np.array_equal(read_exr(tmp_path / "a.exr"), DEPTH)


def test_a_frame_may_name_one_as_its_depth_map(tmp_path):
    write_exr(tmp_path / "a.exr", {"Z": np.where(DEPTH > 2.0, DEPTH, np.float32(np.inf))})
    depth = read_depth_map(DepthFile(tmp_path / "a.exr", 0.5), (32, 24)).numpy()
    assert np.array_equal(depth, np.where(DEPTH > 2.0, 0.5 * DEPTH, 0.0))


def test_other_files_are_refused_in_one_line(tmp_path, monkeypatch, capfd):
    write_exr(tmp_path / "a.exr", {"Z": DEPTH})
    whole = (tmp_path / "a.exr").read_bytes()
    for name, content in {"cut": whole[:-40], "head": whole[:100], "text": b"depth", "empty": b""}.items():
        (tmp_path / f"{name}.exr").write_bytes(content)
        with pytest.raises(UserError, match=rf"{name}.exr: does not decode as OpenEXR; save it again"):
            read_exr(tmp_path / f"{name}.exr")
    with pytest.raises(UserError, match=r"none.exr: no such file"):
        read_exr(tmp_path / "none.exr")
    write_exr(tmp_path / "b.exr", {"R": DEPTH, "G": DEPTH, "B": DEPTH})
    with pytest.raises(UserError, match="has the channels B, G, R; save the depth as the only channel"):
        read_exr(tmp_path / "b.exr")
    monkeypatch.setattr(exr_files, "MOST_NUMBERS", DEPTH.size - 1)
    with pytest.raises(UserError, match="has more than 191 numbers"):
        read_exr(tmp_path / "a.exr")
    written = capfd.readouterr()
    assert written.out == "" and written.err == ""


def test_a_part_of_a_picture_is_refused(tmp_path):
    """Its pixels would be stretched over the whole image."""
    corners = np.array([0, 0], np.int32), np.array([31, 23], np.int32)
    header = {"type": OpenEXR.scanlineimage, "displayWindow": corners}
    OpenEXR.File(header, {"Z": DEPTH}).write(str(tmp_path / "a.exr"))
    with pytest.raises(UserError, match="its data window is not its display window; save the whole picture"):
        read_exr(tmp_path / "a.exr")


def test_without_the_package_its_name_is_told(tmp_path, monkeypatch):
    write_exr(tmp_path / "a.exr", {"Z": DEPTH})
    monkeypatch.delattr(OpenEXR, "File")  # as before version 3.3
    with pytest.raises(UserError, match=r"a.exr: .*pip install \"scgs-warp\[exr\]\" --upgrade"):
        read_exr(tmp_path / "a.exr")
    monkeypatch.setattr(exr_files, "reads_exr", lambda: False)
    with pytest.raises(UserError, match=r"a.exr: .*pip install \"scgs-warp\[exr\]\"$"):
        read_exr(tmp_path / "a.exr")
