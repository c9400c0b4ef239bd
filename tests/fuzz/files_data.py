"""Data sets of every layout, their points and their true motion."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import torch

from fuzz.files_cases import Format, check_dataset, expect, finite, suffixed, within
from helpers.layouts import write_colmap, write_nerfies, write_panoptic, write_poses_bounds
from helpers.nerfstudio_files import HEIGHT, WIDTH, viewmat
from helpers.nerfstudio_files import write as write_nerfstudio_plain
from helpers.rig_layouts import write_actors_hq, write_easymocap, write_instants, write_multipleview
from helpers.tiny import write_dnerf
from scgs_warp.data import load
from scgs_warp.data.camera_path import read_camera_path
from scgs_warp.evaluation.motion_metrics import load_ground_truth, score_motion
from scgs_warp.evaluation.thin_structures import RodCheck, load_rods
from scgs_warp.export.tracks import read_points
from scgs_warp.geometry.cameras import Overview
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.types import Camera, Frame

PICTURES = (".png", ".jpg", ".webp")


def load_train(folder: Path) -> None:
    data = load(folder, "train")
    check_dataset(data)
    unit = Normalisation.fit(data.cameras, data.points)
    finite("normalisation", unit.centre, unit.scale)
    expect(unit.scale > 0, "scale of the scene")


def load_smaller(folder: Path) -> None:
    check_dataset(load(folder, "test", downscale=2, background="white"))


def write_nerfstudio(folder: Path) -> None:
    """With a bent lens, masks, points, and pictures of three formats."""
    content = write_nerfstudio_plain(folder, 6, k1=0.01, k2=-0.002, p1=0.0, p2=0.0, camera_model="OPENCV")
    for index, frame in enumerate(content["frames"]):
        old = folder / frame["file_path"]
        name = f"f_{index}{PICTURES[index % 3]}"
        image = cv2.imread(str(old))
        old.unlink()
        cv2.imwrite(str(folder / name), image)
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[:4, :4] = 0
        cv2.imwrite(str(folder / f"mask_{index}.png"), mask)
        frame |= {"file_path": name, "mask_path": f"mask_{index}.png"}
    (folder / "transforms.json").write_text(json.dumps(content))


def write_splits(folder: Path) -> None:
    """With lists of files, a frame's own intrinsics, and points as a binary PLY."""
    from plyfile import PlyData, PlyElement

    names = [f"f_{index}.png" for index in range(6)]
    content = write_nerfstudio_plain(folder, 6, train_filenames=names[:4], test_filenames=names[4:])
    content["frames"][0] |= {"fl_x": 51.0, "fl_y": 52.0, "cx": 19.0}
    content["distortion_params"] = [0.01, 0.0, 0.0, 0.0, 0.0, 0.0]
    rows = np.zeros(30, [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")])
    for axis in "xyz":
        rows[axis] = np.random.default_rng(2).uniform(-1, 1, 30)
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(folder / "points.ply"))
    (folder / "transforms.json").write_text(json.dumps(content))


def write_truth(folder: Path) -> None:
    folder.mkdir()
    random = np.random.default_rng(1)
    np.savez(
        folder / "ground_truth.npz",
        points=random.uniform(-1, 1, (4, 20, 3)).astype(np.float32),
        times=np.linspace(0, 1, 4).astype(np.float32),
        visible=random.random((3, 20)) < 0.8,
        height=np.float32(1.5),
    )


def load_truth(folder: Path) -> None:
    truth = load_ground_truth(folder)
    if truth is None:
        return
    finite("points", truth.points)
    within("times", truth.times)
    within("height", truth.height, 1e-30, 1e30)
    start = torch.from_numpy(np.random.default_rng(3).uniform(-1, 1, (50, 3))).float()
    score = score_motion(truth, lambda time: start + time)
    if len(truth.times) >= 3 and bool(truth.visible.any()) and truth.points.shape[1]:
        finite("score", *score)


def write_rods(folder: Path) -> None:
    folder.mkdir()
    random = np.random.default_rng(4)
    np.savez(
        folder / "rods.npz",
        names=np.array(["arm", "leg"]),
        radii=np.array([0.3, 0.4], np.float32),
        test_ends=random.uniform(-1, 1, (3, 2, 2, 3)).astype(np.float32),
    )


def load_rod_ratios(folder: Path) -> None:
    rods = load_rods(folder, "test", 3)
    if rods is None:
        return
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4.0
    K = torch.tensor([[60.0, 0.0, 24.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]])
    alpha, check = torch.full((48, 48), 0.7), RodCheck(rods)
    for index in range(3):
        check.add(index, Frame(Camera(viewmat, K, 48, 48), 0.0, alpha.expand(3, 48, 48), alpha), 0.5 * alpha)
    finite("ratios", *(segment.ratio for *_, segment in check.rows))
    expect(check.summary()["rods_segments"] == len(check.rows), "number of tenths")


def write_points(folder: Path) -> None:
    folder.mkdir()
    (folder / "points.csv").write_text("x,y,z\n0.5,-1,0.25\n1e-3,2,-7.5\n", encoding="utf-8")


def load_points(folder: Path) -> None:
    points = read_points(folder / "points.csv")
    expect(points.ndim == 2 and points.shape[1] == 3 and len(points) > 0, "shape of points")
    within("points", points, -1e9, 1e9)


def write_paths(folder: Path) -> None:
    """A camera path in nerfstudio's layout, and one as a list of frames."""
    folder.mkdir()
    poses = [np.linalg.inv(viewmat(index)) @ np.diag([1.0, -1.0, -1.0, 1.0]) for index in range(3)]
    path = {"camera_path": [{"camera_to_world": pose.ravel().tolist(), "fov": 50.0, "time": 0.5} for pose in poses]}
    frames = {"fl_x": 40.0, "w": 60, "h": 40, "frames": [{"transform_matrix": pose.tolist()} for pose in poses]}
    (folder / "path.json").write_text(json.dumps({**path, "render_width": 60, "render_height": 40}))
    (folder / "frames.json").write_text(json.dumps(frames))


def load_paths(folder: Path) -> None:
    overview = Overview((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 4.0, 40.0, 20.0)
    for name in ("path.json", "frames.json"):
        for camera, time in read_camera_path(folder / name, overview).film(4, 64):
            finite("camera of a path", camera.viewmat, camera.K)
            expect(2 <= camera.width <= 64 and 2 <= camera.height <= 64, "size of a picture")
            if time is not None:
                within("time", time)


NOT_PICTURES = suffixed(".json", ".npy", ".npz", ".ply", ".bin", ".txt")

FORMATS = (
    Format("dnerf", lambda folder: write_dnerf(folder) and None, load_train),
    Format("nerfstudio", write_nerfstudio, load_train, share=2.0),
    Format("nerfstudio-lists", write_splits, load_train, NOT_PICTURES),
    Format("nerfstudio-smaller", write_nerfstudio, load_smaller, share=0.5),
    Format("nerfies", lambda folder: write_nerfies(folder, 6), load_train, NOT_PICTURES),
    Format("panoptic", lambda folder: write_panoptic(folder, 3, 3), load_train, NOT_PICTURES),
    Format("camera_path", write_paths, load_paths),
    Format("poses_bounds", lambda folder: write_poses_bounds(folder, 3, 2), load_train),
    Format("multipleview", write_multipleview, load_train, NOT_PICTURES, share=0.5),
    Format("instants", write_instants, load_train, NOT_PICTURES, share=0.5),
    Format("easymocap", write_easymocap, load_train, suffixed(".yml")),
    Format("actors_hq", write_actors_hq, load_train, suffixed(".csv")),
    Format("colmap-binary", lambda folder: write_colmap(folder, 6), load_train, NOT_PICTURES),
    Format("colmap-text", lambda folder: write_colmap(folder, 6, "OPENCV", True), load_train, NOT_PICTURES),
    Format("ground-truth", write_truth, load_truth),
    Format("rods", write_rods, load_rod_ratios),
    Format("points", write_points, load_points, share=0.5),
)
