"""The layout of Neural 3D Video: a rig of cameras, reduced images, faults."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.data_faults import NAN, message, noise
from helpers.layouts import (
    FOCAL,
    HEIGHT,
    WIDTH,
    save_image,
    share_found,
    viewmat,
    write_colmap,
    write_poses_bounds,
)
from scgs_warp.data import load
from scgs_warp.errors import UserError

FOUND = 0.75
"""Share of the points whose colour is at their pixel; the others hide."""


@pytest.mark.parametrize("inner", ["images", "."])
def test_poses_bounds(tmp_path, inner):
    write_poses_bounds(tmp_path, inner=inner)
    train, test = load(tmp_path, "train"), load(tmp_path, "test")
    assert share_found(train) > FOUND and share_found(test) > FOUND
    assert [frame.name for frame in test] == ["cam00_0000", "cam00_0001", "cam00_0002"]
    assert train.times.tolist() == [0.0, 0.5, 1.0] * 3 and len(train) == 9
    np.testing.assert_allclose(test[0].camera.viewmat, viewmat(0, 0.4), atol=1e-6)


def test_poses_bounds_of_reduced_images(tmp_path):
    write_poses_bounds(tmp_path)
    for file in tmp_path.glob("cam*/images/*.png"):
        image = cv2.imread(str(file))
        cv2.imwrite(str(file), cv2.resize(image, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA))
    camera = load(tmp_path)[0].camera
    assert [float(camera.K[0, 0]), float(camera.K[1, 2])] == [FOCAL / 2, HEIGHT / 4]


@pytest.mark.parametrize("rig", [False, True])
def test_a_model_beside_the_file(tmp_path, rig):
    """LLFF and others keep the file beside the COLMAP model of one camera's images; a rig has a folder per camera."""
    bounds, model = tmp_path / "bounds", tmp_path / "model"
    write_poses_bounds(bounds)
    write_colmap(model)
    if rig:
        (model / "sparse").rename(bounds / "sparse")
    else:
        (bounds / "poses_bounds.npy").rename(model / "poses_bounds.npy")
        (model / "images_4").mkdir()
    assert load(bounds if rig else model, "test")[0].name == ("cam00_0000" if rig else "frame_5")


def test_videos_are_to_be_unpacked(tmp_path):
    write_poses_bounds(tmp_path)
    for camera in range(4):
        for file in (tmp_path / f"cam{camera:02d}/images").iterdir():
            file.unlink()
        (tmp_path / f"cam{camera:02d}.mp4").write_bytes(b"film")
    with pytest.raises(UserError, match=r"cam00\.mp4: a video, not images; .*capture\.py --rig"):
        load(tmp_path)


def bounds(edit):
    def fault(folder: Path) -> None:
        rows = np.load(folder / "poses_bounds.npy")
        np.save(folder / "poses_bounds.npy", edit(rows))

    return fault


def entry(row: int, column: int, value: float):
    def edit(rows: np.ndarray) -> np.ndarray:
        rows[row, column] = value
        return rows

    return bounds(edit)


def other_name(folder: Path) -> None:
    image = folder / "cam01/images/0002.png"
    image.with_name("x.png").write_bytes(image.read_bytes())


def test_images_that_are_missing(tmp_path):
    """The others keep their times."""
    write_poses_bounds(tmp_path)
    (tmp_path / "cam01/images/0001.png").unlink()
    train = load(tmp_path, "train")
    assert len(train) == 8 and share_found(train) > FOUND
    assert {frame.name: frame.time for frame in train}["cam01_0002"] == 1.0
    assert any(
        "1 of 9 frames are left out, because their images are missing (0001.png)" in note for note in train.notes
    )


def test_what_systems_hide_is_no_image(tmp_path):
    """macOS puts such files beside others on disks of other systems."""
    write_poses_bounds(tmp_path)
    for file in list(tmp_path.rglob("*.png")):
        file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7")
    (tmp_path / ".hidden").mkdir()
    cv2.imwrite(str(tmp_path / ".hidden/a.png"), np.zeros((9, 9), np.uint8))
    assert len(load(tmp_path)) == 9 and not load(tmp_path).notes


def test_folders_of_other_images_beside_the_cameras(tmp_path):
    """Scripts put images for COLMAP there."""
    write_poses_bounds(tmp_path)
    for name in ("image_colmap", "cam_mask"):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "r_000.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    train = load(tmp_path)
    assert len(train) == 9 and share_found(train) > FOUND
    assert len(train.notes) == 1 and train.notes[0].endswith("these are left out: cam_mask, image_colmap")


FAULTS = {
    "damaged": (noise("poses_bounds.npy"), "poses_bounds.npy: no sound"),
    "shape": (bounds(lambda rows: rows[:, :15]), "has shape [4, 15]"),
    "rows": (bounds(lambda rows: rows[:3]), "has 3 rows, but"),
    "nan": (entry(1, 0, NAN), "row 1 holds a matrix that is not a finite rotation"),
    "scaled": (entry(2, 0, 5.0), "row 2 holds a matrix that is not a finite rotation"),
    "focal": (entry(1, 14, 0.0), "row 1 has a non-positive"),
    "aspect": (entry(1, 9, 300.0), "row 1 is of 300 x 60 pixels, but the images are 80 x 60"),
    "one camera less": (other_name, "cam01/images: holds 4 images, but cam00 3"),
    "undecodable": (noise("cam01/images/0001.png"), "0001.png: not an image"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named(tmp_path, fault):
    edit, expected = FAULTS[fault]
    write_poses_bounds(tmp_path)
    edit(tmp_path)
    assert expected in message(tmp_path)


@pytest.mark.parametrize("name", ["{:03d}", "frame{}"])
def test_a_film_of_one_camera(tmp_path, name):
    """The data of Neural Scene Flow Fields; rows are in the order of LLFF, which puts 10 before 9."""
    write_poses_bounds(tmp_path, cameras=12, instants=1)
    rows = np.load(tmp_path / "poses_bounds.npy")
    (tmp_path / "images").mkdir()
    names = [name.format(index) for index in range(12)]
    for index in range(12):
        (tmp_path / f"cam{index:02d}/images/0000.png").rename(tmp_path / f"images/{names[index]}.png")
    np.save(tmp_path / "poses_bounds.npy", rows[np.argsort(names)])
    train, test = load(tmp_path), load(tmp_path, "test")
    assert share_found(train) > FOUND and share_found(test) > FOUND
    assert [frame.name for frame in test] == [names[4]] and len(train) == 11
    assert {frame.name: round(frame.time * 11) for frame in train}[names[10]] == 10 and train.bounds == (1.0, 9.0)


def write_nsff(folder: Path, cameras: int = 4, instants: int = 6) -> None:
    """The data of Yoon et al. for Neural Scene Flow Fields: the film takes the cameras, which stand, in turn."""
    write_poses_bounds(folder, cameras=cameras, instants=1)
    shown = [
        (folder / f"cam{camera:02d}/images/0000.png").rename(folder / f"{camera}.png") for camera in range(cameras)
    ]
    for camera in range(cameras):
        (folder / f"cam{camera:02d}/images").rmdir()
        (folder / f"cam{camera:02d}").rmdir()
    for instant in range(instants):
        for camera, file in enumerate(shown):
            save_image(folder / f"mv_images/{instant:05d}/cam{camera + 1:02d}.png", cv2.imread(str(file)))
        save_image(folder / f"images/{instant:05d}.png", cv2.imread(str(shown[instant % cameras])))
        save_image(folder / f"motion_masks/{instant:05d}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    for file in shown:
        file.unlink()
    rows = np.load(folder / "poses_bounds.npy")
    np.save(folder / "poses_bounds.npy", rows[np.arange(instants) % cameras])


def test_views_of_the_other_cameras_are_held_out(tmp_path):
    write_nsff(tmp_path)
    train, test = load(tmp_path), load(tmp_path, "test")
    assert share_found(train) > FOUND and share_found(test) > FOUND
    assert len(train) == 6 and len(test) == 6 * 3 and sorted(set(test.times.tolist())) == train.times.tolist()
    assert [frame.name for frame in test.entries[:4]] == ["00000_cam02", "00000_cam03", "00000_cam04", "00001_cam01"]
    assert len(load(tmp_path, "test", frames="2:4")) == 2 * 3
    (tmp_path / "mv_images/00003/cam02.png").unlink()
    assert len(load(tmp_path, "test")) == 1, "every eighth, where views are missing"


def test_images_of_all_cameras_in_one_folder(tmp_path):
    write_poses_bounds(tmp_path)
    for camera in sorted(path for path in tmp_path.iterdir() if path.is_dir()):
        for file in sorted(camera.rglob("*.png")):
            (tmp_path / "images").mkdir(exist_ok=True)
            file.rename(tmp_path / "images" / f"{camera.name}_{file.name}")
    assert "holds 1 folders of images (images to images)" in message(tmp_path)
