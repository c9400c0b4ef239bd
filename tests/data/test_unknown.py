"""Paths that hold no data set: the message says what they are and what to do with them."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.nerfstudio_files import write
from scgs_warp.capture import import_scene
from scgs_warp.data import load
from scgs_warp.errors import UserError


def said(path: Path) -> str:
    with pytest.raises(UserError) as caught:
        load(path)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(str(path))
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("film.MP4", "scgs-warp capture {path} --output data/film"),
        ("scene.tar.gz", "unpack it"),
        ("cloud.spz", "scgs-warp view --ply {path}"),
        ("transforms.json", "give its folder: --data {path.parent}"),
        ("one.jpg", "is one image"),
        ("notes", "is a file"),
        ("scene.npz", "scgs-warp capture --poses {path} --output data/scene"),
        ("take.r3d", "scgs-warp capture --poses {path} --output data/take"),
    ],
)
def test_files(name, expected, tmp_path):
    path = tmp_path / name
    path.write_bytes(b"")
    assert expected.format(path=path) in said(path)


def test_commands_can_be_copied_to_a_shell(tmp_path):
    path = tmp_path / "my film.mp4"
    path.write_bytes(b"")
    assert f"scgs-warp capture '{path}' --output 'data/my film'" in said(path)


def test_a_mistyped_name(tmp_path):
    (tmp_path / "garden").mkdir()
    assert said(tmp_path / "graden").endswith(f"no such folder; did you mean {tmp_path / 'garden'}?")
    assert "did you mean" not in said(tmp_path / "nowhere" / "else")


def test_folders_around_a_data_set(tmp_path):
    write(tmp_path / "a/b/scene")
    (tmp_path / "a/b/scene/images/small").mkdir(parents=True)
    (tmp_path / "a/b/scene/images/small/x.png").write_bytes(b"")
    assert f"--data {tmp_path / 'a/b/scene'}" in said(tmp_path / "a")
    assert said(tmp_path / "a/b/scene/images/small").endswith(f"--data {tmp_path / 'a/b/scene'}")


def test_folders_of_something_else(tmp_path):
    for name in ("photos", "run", "films", "empty"):
        (tmp_path / name).mkdir()
    for index in range(3):
        cv2.imwrite(str(tmp_path / f"photos/{index}.jpg"), np.zeros((9, 9, 3), np.uint8))
    (tmp_path / "run/checkpoint.safetensors").write_bytes(b"")
    assert f"scgs-warp capture {tmp_path / 'photos'}" in said(tmp_path / "photos")
    assert "is the folder of a run" in said(tmp_path / "run")
    assert "is empty" in said(tmp_path / "empty")


def test_a_folder_that_holds_a_film(tmp_path):
    (tmp_path / "take.mov").write_bytes(b"")
    with pytest.raises(UserError, match=r"take\.mov: a video has no cameras yet"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("transformations.json", "call it transforms.json if it lists frames and poses"),
        (
            "poses_bounds_RoDynRF.npy",
            "call it poses_bounds.npy if it lists the cameras of LLFF, as RoDynRF writes them",
        ),
    ],
)
def test_a_file_of_cameras_under_another_name(tmp_path, name, expected):
    """Older scripts of Spectacular AI write ``transformations.json``."""
    (tmp_path / "images").mkdir()
    (tmp_path / name).write_text("{}")
    assert said(tmp_path) == f"{tmp_path / name}: is read under another name; {expected}"


@pytest.mark.parametrize(
    ("files", "program"),
    [
        (["keyframes/cameras/1.json", "keyframes/images/1.jpg", "mesh_info.json"], "Polycam"),
        (["metadata.json", "rgb/0.jpg", "depth/0.exr"], "Record3D"),
        (["EXR_RGBD/metadata", "EXR_RGBD/rgbd/0.jpg"], "Record3D"),
        (["frame_00000.json", *(f"frame_0000{index}.jpg" for index in range(4))], "3D Scanner App"),
        (["pred_traj.txt", *(f"frame_000{index}.png" for index in range(4))], "MonST3R"),
        (["odometry.csv", "rgb.mp4", "depth/000000.png"], "Stray Scanner"),
        (["camera/000000.npz", "color/000000.png"], "CUT3R"),
        (["camera_poses.txt", "results_output/frame_0.npz"], "DA3-Streaming"),
        (["0000.npz", "0001.npz", "fused_4d.npz"], "Uni4D"),
        (["pose/film.npz", "rgb/film.mp4", "intrinsics/film.npz"], "ViPE"),
    ],
)
def test_exports_that_capture_reads(tmp_path, files, program):
    """Their images have cameras, so that they need not be found."""
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert f"is an export of {program}; make a data set of it: scgs-warp capture --poses {tmp_path}" in said(tmp_path)


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (
            ["annots.npy", "Camera_B1/000000.jpg"],
            "a pickle, which can run programs; write them in the layout of EasyMocap",
        ),
        (["rgb.txt", "groundtruth.txt", "rgb/1.5.png"], "find them: scgs-warp capture {path}/rgb --output data/"),
        (["color/0.jpg", "pose/0.txt", "depth/0.png"], "find them: scgs-warp capture {path}/color --output data/"),
        (["models.json", "camera_0001.mp4"], "find them: scgs-warp capture --rig {path} --output data/"),
        (["cameras_sphere.npz", "image/000.png"], "NeuS are not read; write them in the layout of nerfstudio"),
        (["images/000_0.jpg", "ego_pose/000.txt", "extrinsics/0.txt"], "Waymo, as EmerNeRF and others write them"),
        (["a/frame-000000.pose.txt", *(f"a/frame-00000{i}.png" for i in range(4))], "7-Scenes are not read; write"),
        (["0012_11.smc"], "0012_11.smc: images and cameras in HDF5, as those of DNA-Rendering, are not read; unpack"),
    ],
)
def test_data_sets_that_are_not_read(tmp_path, files, expected):
    """They are answered with a way to go on."""
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert expected.format(path=tmp_path) in said(tmp_path)


def test_keyframes_of_mast3r_slam(tmp_path):
    """They lie in a folder of Polycam's name, but have no cameras there; the trajectory is a file beside it."""
    (tmp_path / "keyframes/film").mkdir(parents=True)
    (tmp_path / "film.txt").write_text("0.0 0 0 0 0 0 0 1\n")
    for index in range(4):
        (tmp_path / f"keyframes/film/{index}.5.png").write_bytes(b"")
    assert f"scgs-warp capture {tmp_path}/keyframes/film" in said(tmp_path)
    with pytest.raises(UserError, match="is no scene of"):
        import_scene(tmp_path, tmp_path / "data")


def test_cameras_in_no_known_layout(tmp_path):
    """KITTI, DAVIS and what networks prepare: the photographs are found, not the maps of as many pixels beside them."""
    for name in ("depth/480p/bear", "JPEGImages/480p/bear", "Annotations/480p/bear"):
        (tmp_path / name).mkdir(parents=True)
        for index in range(4):
            (tmp_path / name / f"{index:05d}.png").write_bytes(b"")
    photos = tmp_path / "JPEGImages/480p/bear"
    assert f"or find those of bear anew: scgs-warp capture {photos} --output data/" in said(tmp_path)
    shutil.rmtree(tmp_path / "JPEGImages")
    assert "holds no known layout" in said(tmp_path)


@pytest.mark.parametrize(
    ("name", "start", "command"),
    [
        ("cameras.xml", '<?xml version="1.0"?>\n<document version="2.0.0">\n  <chunk label="a"', "metashape"),
        ("cameras.csv", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n", "realitycapture"),
        ("scene.out", "# Bundle file v0.3\n2 9\n", "model_converter"),
    ],
)
def test_cameras_of_other_programs(tmp_path, name, start, command):
    (tmp_path / "a.csv").write_text("x,y\n")
    (tmp_path / name).write_text(start)
    assert command in said(tmp_path) and "export them from there for COLMAP" in said(tmp_path)
