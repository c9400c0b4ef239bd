"""Points of a COLMAP model beside cameras that another program has turned, scaled and moved."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.layouts import HEIGHT, POINTS, WIDTH, K, save_json, viewmat, write_colmap
from scgs_warp.data import load

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
COUNT = 14
NERFSTUDIO = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
"""World of older versions of ns-process-data, which they do not name in the file."""
TURNED = Rotation.from_euler("xyz", [20, 40, -70], degrees=True).as_matrix()


def write(folder: Path, turn: np.ndarray, scale: float, shift: np.ndarray, model: str = "colmap/sparse/0") -> dict:
    """Cameras of nerfstudio whose world is that of the model, turned, scaled and moved; returns the content."""
    write_colmap(folder)
    (folder / model).parent.mkdir(parents=True, exist_ok=True)
    shutil.move(folder / "sparse/0", folder / model)
    (folder / "sparse").rmdir()
    frames = []
    for index in range(COUNT):
        pose = np.linalg.inv(viewmat(index))
        pose[:3, :3], pose[:3, 3] = turn @ pose[:3, :3], scale * turn @ pose[:3, 3] + shift
        frames.append(
            {"file_path": f"./images/frame_{index + 1}.png", "transform_matrix": (pose @ OPENGL).tolist()},
        )
    content = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": WIDTH, "h": HEIGHT}
    content |= {"camera_model": "OPENCV", "k1": 0.0, "frames": frames}
    save_json(folder / "transforms.json", content)
    return content


@pytest.mark.parametrize(
    ("turn", "scale", "shift", "model"),
    [
        (np.eye(3), 1.0, np.zeros(3), "colmap/sparse/0"),
        (NERFSTUDIO, 1.0, np.zeros(3), "colmap/sparse/0"),
        (TURNED, 0.31, np.array([1.0, -2.0, 0.5]), "colmap_sparse/0"),  # as colmap2nerf.py of instant-ngp
        (TURNED, 2.0, np.array([4e5, 5e6, 20.0]), "colmap/sparse/0"),
    ],
)
def test_points_move_with_the_cameras(tmp_path, turn, scale, shift, model):
    write(tmp_path, turn, scale, shift, model)
    for split in ("train", "test"):
        data = load(tmp_path, split)
        assert data.points is not None and data.colors is not None
        offset = np.rint(shift) if np.abs(shift).max() > 1e5 else np.zeros(3)
        expected = scale * POINTS @ turn.T + shift - offset
        middle = np.median(data.points.numpy() - expected, axis=0)  # a far origin moves to the middle of the cameras
        np.testing.assert_allclose(data.points.numpy() - expected, np.tile(middle, (len(expected), 1)), atol=1e-3)
        camera = data[0].camera
        ahead = (data.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])[:, 2]
        own = (POINTS @ viewmat(int(data[0].name[6:]) - 1)[2, :3]) + viewmat(int(data[0].name[6:]) - 1)[2, 3]
        np.testing.assert_allclose(ahead.numpy(), scale * own, rtol=1e-3)


def test_a_file_of_points_comes_first(tmp_path):
    from helpers.nerfstudio_files import write_ply

    content = write(tmp_path, np.eye(3), 1.0, np.zeros(3))
    write_ply(tmp_path / "points.ply", POINTS[:5], None)
    save_json(tmp_path / "transforms.json", {**content, "ply_file_path": "points.ply"})
    points = load(tmp_path).points
    assert points is not None and len(points) == 5


@pytest.mark.parametrize("fault", ["bent", "mirrored", "few", "names", "damaged", "empty", "still"])
def test_models_that_do_not_fit_give_no_points(tmp_path, fault):
    """The cameras are complete without the model, so that nothing is refused."""
    content = write(tmp_path, TURNED, 0.5, np.ones(3))
    frames, model = content["frames"], tmp_path / "colmap/sparse/0"
    for index, frame in enumerate(frames):
        pose = np.array(frame["transform_matrix"])
        if fault == "bent" and index == 3:
            pose[:3, 3] += 0.05
        if fault == "mirrored":
            pose[:3, 3] *= -1.0
        if fault == "still":
            pose[:3, 3] = 1.0
        if fault == "names":
            name = f"./images/photo_{index}.png"
            (tmp_path / frame["file_path"]).rename(tmp_path / name)
            frame["file_path"] = name
        frame["transform_matrix"] = pose.tolist()
    if fault == "few":
        content["frames"] = frames[:2]
    if fault == "damaged":
        (model / "images.bin").write_bytes((model / "images.bin").read_bytes()[:100])
    if fault == "empty":
        (model / "points3D.bin").write_bytes(bytes(8))
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert load(tmp_path).points is None
