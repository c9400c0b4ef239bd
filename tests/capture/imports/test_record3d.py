"""Exports of Record3D: images without a pose, depth in OpenEXR and LZFSE, and what is told if a decoder is missing."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from helpers.data_faults import change
from helpers.foreign_scenes import COUNT, wall, write_record3d
from helpers.importing import entries, refused, silent
from scgs_warp.capture import import_scene
from scgs_warp.capture.imports import phone_apps
from scgs_warp.data import load
from scgs_warp.errors import UserError


def test_images_of_record3d_that_are_missing(tmp_path):
    """The others keep their poses and moments; images without a pose have none."""
    record = write_record3d(tmp_path / "record3d")
    whole = phone_apps.read_record3d(record).frames
    (record / "rgb/3.png").unlink()
    scene = phone_apps.read_record3d(record)
    assert scene.note is not None and scene.note.startswith("1 of 6 poses have no image in rgb, and are left out")
    for one, two in zip(scene.frames, [*whole[:3], *whole[4:]], strict=True):
        assert one.image == two.image and one.moment == two.moment and (one.viewmat == two.viewmat).all()
    (record / "rgb/7.png").write_bytes((record / "rgb/0.png").read_bytes())
    (record / "rgb/8.png").write_bytes((record / "rgb/0.png").read_bytes())
    with pytest.raises(UserError, match=r"6 poses, but .* holds 7 images"):
        phone_apps.read_record3d(record)


def test_recordings_without_poses_are_refused(tmp_path):
    """Of the camera that sees faces, the app writes the identity for each frame."""
    record = write_record3d(tmp_path / "record3d")
    still = [[0, 0, 0, 1, 0, 0, 0]] * COUNT
    change(record / "metadata.json", lambda content: content.update(poses=still))
    refused(record, tmp_path, "all poses are the same, .* images in its folder rgb: scgs-warp capture FOLDER")
    change(record / "metadata.json", lambda content: content.update(poses=[*still[1:], [0, 0, 0, 1, 0.1, 0, 0]]))
    assert import_scene(record, tmp_path / "data", silent).frames == COUNT


def test_the_folder_above_an_export_of_record3d(tmp_path):
    """Its depth is found there, too."""
    pytest.importorskip("OpenEXR")
    write_record3d(tmp_path / "capture/EXR_RGBD")
    made = import_scene(tmp_path / "capture", tmp_path / "data", silent)
    assert made.program == "Record3D" and made.points > 0 and len(load(tmp_path / "data").with_depth) > 0


def test_without_openexr_the_cameras_of_record3d_are_imported(tmp_path, monkeypatch):
    """And a line says what is missing."""
    record = write_record3d(tmp_path / "record3d")
    (record / "depth").mkdir(exist_ok=True)
    (record / "depth/0.exr").touch()
    monkeypatch.setattr(phone_apps, "reads_exr", lambda: False)
    made = import_scene(record, tmp_path / "data", silent)
    assert made.frames == COUNT and made.points == 0 and not load(tmp_path / "data").with_depth
    assert made.note is not None and "depth was not read" in made.note and "scgs-warp[exr]" in made.note


def test_an_unpacked_r3d(tmp_path):
    record = write_record3d(tmp_path / "record3d")
    (record / "metadata.json").rename(record / "metadata")
    (record / "rgb").rename(record / "rgbd")
    assert import_scene(record, tmp_path / "data", silent).program == "Record3D"
    np.testing.assert_allclose(entries(tmp_path / "data")[2].camera.viewmat.numpy(), wall().viewmats[2], atol=1e-4)


def unpacked_r3d(folder: Path, sure: int = 2, **stated: int) -> Path:
    """An unpacked .r3d with depth, whose left half has the confidence ``sure``."""
    imagecodecs = pytest.importorskip("imagecodecs")
    record = write_record3d(folder)
    (record / "metadata.json").rename(record / "metadata")
    (record / "rgb").rename(record / "rgbd")
    shutil.rmtree(record / "depth", ignore_errors=True)
    change(record / "metadata", lambda content: content.update(stated))
    for index, depth in enumerate(wall().depths):
        levels = np.where(np.arange(depth.shape[1]) < depth.shape[1] // 2, sure, 2) * np.ones_like(depth)
        for suffix, values in (("depth", depth.astype("<f4")), ("conf", levels.astype(np.uint8))):
            (record / f"rgbd/{index}.{suffix}").write_bytes(imagecodecs.lzfse_encode(values.tobytes()))
    return record


def test_the_depth_of_an_unpacked_r3d(tmp_path):
    rows, columns = wall().depths[0].shape
    made = import_scene(unpacked_r3d(tmp_path / "r", dw=columns, dh=rows), tmp_path / "data", silent)
    data = load(tmp_path / "data")
    assert made.note is None and made.points > 100 and len(data.with_depth) == len(data)
    depth = data.depth(0)
    assert depth is not None and depth.shape == (rows, columns)
    index = int(data.entries[0].name.split("_")[1])
    np.testing.assert_allclose(depth, wall().depths[index], rtol=2e-3)


def test_depth_of_an_r3d_that_is_not_sure_is_unknown(tmp_path):
    rows, columns = wall().depths[0].shape
    record = unpacked_r3d(tmp_path / "r", 0, dw=columns, dh=rows)
    loads = [frame.depth for frame in phone_apps.read_record3d(record).frames]
    assert all(load is not None and not load()[:, : columns // 2].any() and load().any() for load in loads)
    (record / "rgbd/1.conf").write_bytes(b"")
    assert loads[1] is not None and loads[1]()[:, : columns // 2].any(), "the camera for faces has no confidence"


def test_damaged_depth_of_an_r3d_is_told_in_one_line(tmp_path):
    rows, columns = wall().depths[0].shape
    record = unpacked_r3d(tmp_path / "r", dw=columns, dh=rows)
    depth = record / "rgbd/1.depth"
    whole = depth.read_bytes()
    depth.write_bytes(whole[:-20])
    refused(record, tmp_path, "1.depth: does not decode as LZFSE; export the capture again")
    depth.write_bytes(whole)
    change(record / "metadata", lambda content: content.update(dh=rows - 1))
    refused(record, tmp_path, f"not {columns} x {rows - 1} pixels")
    change(record / "metadata", lambda content: content.update(dh=1e9))
    refused(record, tmp_path, "dw and dh are")
    change(record / "metadata", lambda content: [content.pop(key) for key in ("dw", "dh")])
    refused(record, tmp_path, "not 192 x 256 or 720 x 960 pixels")


def test_without_imagecodecs_the_cameras_of_an_r3d_are_imported(tmp_path, monkeypatch):
    record = write_record3d(tmp_path / "r")
    (record / "metadata.json").rename(record / "metadata")
    (record / "rgb").rename(record / "rgbd")
    (record / "rgbd/0.depth").touch()
    monkeypatch.setattr(phone_apps, "reads_lzfse", lambda: False)
    made = import_scene(record, tmp_path / "data", silent)
    assert made.frames == COUNT and made.note is not None and "scgs-warp[r3d]" in made.note
