"""Recordings of Stray Scanner: a film, a table of poses that an app logs beside it, and depth."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.foreign_scenes import COUNT, Y_UP, K, wall
from helpers.importing import entries, refused, silent
from scgs_warp.capture import import_scene
from scgs_warp.capture.imports import stray_scanner
from scgs_warp.data import load

HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw"
FURTHER = ", fx, fy, cx, cy, distortion_center_x, distortion_center_y"
"""Columns of newer versions."""
ZOOMED = 1.1


def write(folder: Path, newer: bool = True, pictures: int = COUNT) -> Path:
    """The wall; the lens is that of the rows if they have one, which ``camera_matrix.csv`` then contradicts."""
    made, rows = wall(), [HEADER + (FURTHER if newer else "")]
    for kind in ("depth", "confidence"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    with av.open(str(folder / "rgb.mp4"), "w") as out:
        stream = out.add_stream("libx264rgb", rate=60, options={"crf": "0"})
        stream.width, stream.height, stream.pix_fmt = made.images.shape[2], made.images.shape[1], "rgb24"
        for image in made.images[:pictures]:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        out.mux(stream.encode())
    for index, viewmat in enumerate(made.viewmats):
        pose = np.linalg.inv(Y_UP) @ np.linalg.inv(viewmat)
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        numbers += [K[0, 0], K[1, 1], K[0, 2], K[1, 2], 24.0, 18.0] if newer else []
        rows.append(f"{777.5 + index / 30}, {index:06d}, " + ", ".join(str(value) for value in numbers))
        cv2.imwrite(str(folder / f"depth/{index:06d}.png"), np.rint(made.depths[index] * 1000).astype(np.uint16))
        level = np.full(made.depths[index].shape, 2, np.uint8)
        level[:4] = 0
        cv2.imwrite(str(folder / f"confidence/{index:06d}.png"), level)
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    lens = K * [[ZOOMED], [ZOOMED], [1.0]] if newer else K
    (folder / "camera_matrix.csv").write_text("\n".join(", ".join(str(v) for v in row) for row in lens))
    return folder


@pytest.mark.parametrize("newer", [True, False])
def test_cameras_images_times_and_depth(tmp_path, newer):
    made = import_scene(write(tmp_path / "source", newer), tmp_path / "data", silent)
    assert (made.program, made.frames, made.note) == ("Stray Scanner", COUNT, None) and made.points > 500
    truth, found = wall(), entries(tmp_path / "data")
    views = torch.stack([entry.camera.viewmat for entry in found]).double().numpy()
    np.testing.assert_allclose(views, truth.viewmats, atol=1e-4)
    np.testing.assert_allclose(found[0].camera.K.numpy(), K, atol=1e-4)
    np.testing.assert_allclose([entry.time for entry in found], np.linspace(0, 1, COUNT), atol=1e-3)
    data = load(tmp_path / "data")
    assert np.abs(data[0].image.numpy() * 255 - truth.images[0]).max() <= 2.0
    depth = data.depth(0)
    assert depth is not None and not depth[:4].any(), "the least sure"
    np.testing.assert_allclose(depth[4:].numpy(), truth.depths[0][4:], rtol=2e-3)


def test_of_many_frames_some_are_taken(tmp_path, monkeypatch):
    """The app records 60 frames in a second."""
    monkeypatch.setattr(stray_scanner, "MOST_FRAMES", 3)
    made = import_scene(write(tmp_path / "source"), tmp_path / "data", silent)
    assert (made.frames, made.note) == (3, f"3 of {COUNT} frames are taken")
    truth, found = wall(), entries(tmp_path / "data")
    views = torch.stack([entry.camera.viewmat for entry in found]).double().numpy()
    np.testing.assert_allclose(views, truth.viewmats[::2], atol=1e-4)
    shown = [frame.image for split in ("train", "test") for frame in load(tmp_path / "data", split)]
    assert min(np.abs(image.numpy() * 255 - truth.images[2]).max() for image in shown) <= 2.0


def test_poses_without_a_picture_are_counted(tmp_path):
    made = import_scene(write(tmp_path / "source", pictures=4), tmp_path / "data", silent)
    assert (made.frames, made.note) == (4, f"2 of {COUNT} poses have no picture in rgb.mp4, and are left out")


def test_malformed_recordings(tmp_path):
    source = write(tmp_path / "source")
    track = source / "odometry.csv"
    rows = track.read_text().splitlines()
    for lines, words in (
        ([rows[0].replace(" qw", " w"), *rows[1:]], "has no column qw"),
        (rows[:1], "is no table of numbers with a header"),
        ([], "is no table of numbers with a header"),
        ([*rows[:3], "1, 2, 3"], "is no table of numbers"),
        ([*rows[:3], rows[3].replace("777", "later")], "is no table of numbers"),
        ([*rows[:3], rows[3].replace("777.", "nan, 1.", 1)], "is no table of numbers"),
        ([*rows[:3], rows[2]], "frame does not rise"),
        ([*rows[:3], rows[3].replace("000002", "1e300")], "frame is beyond all films"),
        ([*rows[:2], rows[2].replace(", 50.0, 50.0", ", -50.0, 50.0")], "row 1 is no matrix"),
        ([*rows[:2], ", ".join([*rows[2].split(", ")[:5], "0", "0", "0", "0", *rows[2].split(", ")[9:]])], "length 1"),
    ):
        track.write_text("\n".join(lines) + "\n")
        refused(source, tmp_path, words)
    older = write(tmp_path / "older", newer=False)
    (older / "camera_matrix.csv").write_text("1, 2, 3")
    refused(older, tmp_path, "camera_matrix.csv: holds no nine numbers")
    (older / "camera_matrix.csv").unlink()
    refused(older, tmp_path, "camera_matrix.csv: holds no nine numbers")
    (older / "rgb.mp4").write_bytes(b"no film")
    refused(older, tmp_path, "rgb.mp4: is not a video that decodes")
