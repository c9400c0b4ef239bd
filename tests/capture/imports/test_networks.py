"""Outputs of networks that hold points instead of depth, or a file for each frame: what is damaged, what is missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.foreign_scenes import (
    COUNT,
    K,
    wall,
    world_points,
    write_cut3r,
    write_megasam,
    write_pi3,
    write_streaming,
    write_uni4d,
    write_vggt,
)
from helpers.importing import entries, refused, silent
from scgs_warp.capture import import_scene
from scgs_warp.data import load


def changed(path: Path, **arrays) -> Path:
    """Replace arrays of an .npz, or leave one out (None)."""
    with np.load(path) as old:
        content = {name: old[name] for name in old.files if name not in arrays} | arrays
    np.savez(path, **{name: value for name, value in content.items() if value is not None})
    return path


def test_points_of_pi3_that_noise_moves_give_the_focal_length(tmp_path):
    """Outliers among the points pull it little; unknown points do not count."""
    source = write_pi3(tmp_path / "source")
    points = np.load(source)["points"]
    noise = np.random.default_rng(0)
    points[:, ::7, ::5] += noise.normal(0, 2, points[:, ::7, ::5].shape)
    points[:, 3] = np.nan
    made = import_scene(changed(source, points=points), tmp_path / "data", silent)
    assert made.program == "Pi3"
    for entry in entries(tmp_path / "data"):
        np.testing.assert_allclose(entry.camera.K.numpy(), K, rtol=0.01)
        depth = load(tmp_path / "data").depth(0)
        assert depth is not None and not depth[3].any() and not depth[:, :2].any(), "unknown, and unsure"


def test_points_tell_the_direction_of_poses(tmp_path):
    """Programs built on VGGT write its arrays with camera-to-world poses; points of another scale change nothing."""
    truth = wall()
    turns = truth.viewmats[1:, :3, :3] @ truth.viewmats[0, :3, :3].T
    for name, inverse, scale in (("as VGGT", False, 1.0), ("inverse", True, 1.0), ("unlike the depth", False, 1.3)):
        poses = np.linalg.inv(truth.viewmats) if inverse else truth.viewmats
        points = {"world_points": np.float32(world_points(truth) * scale)}
        source = changed(write_vggt(tmp_path / name / "source"), extrinsic=poses, pose_enc_list=None, **points)
        import_scene(source, tmp_path / name / "data", silent)
        views = torch.stack([entry.camera.viewmat for entry in entries(tmp_path / name / "data")]).double().numpy()
        np.testing.assert_allclose(views[1:, :3, :3] @ views[0, :3, :3].T, turns, atol=1e-4, err_msg=name)


def test_points_that_tell_no_direction(tmp_path):
    """Unknown or misshapen points leave the direction to the program."""
    for number, points in enumerate((np.full((COUNT, 36, 48, 3), np.nan), np.ones((COUNT, 5, 5, 3)))):
        source = changed(write_megasam(tmp_path / f"source{number}"), world_points=points)
        assert import_scene(source, tmp_path / f"data{number}", silent).program == "MegaSaM"


def test_malformed_scenes_of_pi3(tmp_path):
    fresh = lambda: write_pi3(tmp_path / "source")  # noqa: E731
    refused(changed(fresh(), images=None), tmp_path, "holds no images")
    refused(changed(fresh(), points=np.ones((COUNT, 36, 40, 3))), tmp_path, r"points is .* a point for each pixel")
    refused(changed(fresh(), camera_poses=np.zeros((2, 4, 4))), tmp_path, r"camera_poses is \[2, 4, 4\]")
    refused(changed(fresh(), conf=np.ones((COUNT, 5, 5))), tmp_path, "conf is .* does not fit")
    for bad in (np.nan, 0.0):
        refused(changed(fresh(), points=np.full((COUNT, 36, 48, 3), bad)), tmp_path, "points fit no focal length")


def test_cameras_of_cut3r_without_images_are_counted(tmp_path):
    source = write_cut3r(tmp_path / "source")
    (source / "color/000002.png").unlink()
    (source / "depth/000003.npy").unlink()
    (source / "conf/000004.npy").unlink()
    made = import_scene(source, tmp_path / "data", silent)
    assert made.frames == COUNT - 1 and made.note is not None
    assert f"1 of {COUNT} cameras have no image in color, and are left out" in made.note
    times = [entry.time for entry in entries(tmp_path / "data")]
    np.testing.assert_allclose(times, [0.0, 0.2, 0.6, 0.8, 1.0], atol=1e-6)


def test_malformed_folders_of_uni4d(tmp_path):
    fresh = lambda: write_uni4d(tmp_path / str(len([*tmp_path.iterdir()])))  # noqa: E731
    for bad, message in (
        ({"R": np.ones((3, 4))}, "0002.npz: R and t are no pose"),
        ({"R": np.ones((3, 3))}, "0002.npz: R and t is not rigid"),
        ({"K": np.zeros((3, 3))}, "0002.npz: K is no matrix"),
        ({"img": np.zeros((36, 48))}, r"0002.npz: img is \[36, 48\]"),
        ({"disp": None}, "0002.npz"),
    ):
        source = fresh()
        changed(source / "0002.npz", **bad)
        refused(source, tmp_path, message)


def test_malformed_folders_of_cut3r(tmp_path):
    source = write_cut3r(tmp_path / "source")
    np.savez(source / "camera/000001.npz", pose=np.zeros((4, 4)), intrinsics=K)
    refused(source, tmp_path, "000001.npz: pose is not rigid")
    np.savez(source / "camera/000001.npz", pose=np.eye(4))
    refused(source, tmp_path, "holds no array named 'intrinsics'")
    np.savez(source / "camera/000001.npz", pose=np.eye(4), intrinsics=K)
    np.save(source / "conf/000001.npy", np.ones((4, 4)))
    refused(source, tmp_path, r"000001.npy is \[4, 4\], but the depth")


def test_malformed_folders_of_the_streaming_program(tmp_path):
    source = write_streaming(tmp_path / "source")
    file = source / "results_output/frame_3.npz"
    for array, words in (
        (np.zeros((36, 48), np.uint8), r"image is \[36, 48\], not \[H, W, 3\]"),
        (np.full((36, 48, 3), 300.0), "other numbers than 0 to 255"),
        (np.full((36, 48, 3), np.nan), "other numbers than 0 to 255"),
    ):
        refused(_replaced(file, array), tmp_path, words)
    file.unlink()
    refused(source, tmp_path, f"camera_poses.txt has {COUNT} rows, but results_output holds {COUNT - 1} frames")


def _replaced(file: Path, image: np.ndarray) -> Path:
    changed(file, image=image)
    return file.parents[1]


def test_frames_of_the_streaming_program_are_in_the_order_of_numbers(tmp_path):
    """``frame_10`` comes after ``frame_9``."""
    source = write_streaming(tmp_path / "source")
    rows = (source / "camera_poses.txt").read_text().splitlines()
    for index in reversed(range(COUNT)):
        file = source / f"results_output/frame_{index}.npz"
        file.rename(file.with_name(f"frame_{index + 6}.npz"))
    (source / "camera_poses.txt").write_text("\n".join(rows) + "\n")
    import_scene(source, tmp_path / "data", silent)
    views = torch.stack([entry.camera.viewmat for entry in entries(tmp_path / "data")]).double().numpy()
    turns = [v[1:, :3, :3] @ v[0, :3, :3].T for v in (views, wall().viewmats)]
    np.testing.assert_allclose(turns[0], turns[1], atol=1e-4)


@pytest.mark.parametrize("write", [write_cut3r, write_streaming])
def test_frames_without_depth(tmp_path, write):
    source = write(tmp_path / "source")
    for file in source.glob("depth/*.npy"):
        file.unlink()
    for file in source.glob("results_output/*.npz"):
        changed(file, depth=None)
    made = import_scene(source, tmp_path / "data", silent)
    assert (made.frames, made.points, made.note) == (COUNT, 0, None)
