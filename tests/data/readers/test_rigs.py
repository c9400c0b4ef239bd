"""Layouts of rigs with their calibration: 4DGaussians, SpacetimeGaussians, 3DGStream, EasyMocap, ActorsHQ."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.data_faults import message, noise
from helpers.layouts import FOCAL, HEIGHT, POINTS, WIDTH, share_found, viewmat, write_poses_bounds
from helpers.rig_layouts import (
    CAMERAS,
    STEP,
    write_actors_hq,
    write_easymocap,
    write_instants,
    write_multipleview,
)
from scgs_warp.data import load
from scgs_warp.errors import UserError

LAYOUTS = {
    "multipleview": (write_multipleview, 0, ["cam01_frame_00001", "cam01_frame_00002", "cam01_frame_00003"]),
    "colmap": (write_instants, 0, ["cam00_colmap_9", "cam00_colmap_10", "cam00_colmap_11"]),
    "stream": (
        partial(write_instants, name="frame{:06d}"),
        0,
        ["cam00_frame000009", "cam00_frame000010", "cam00_frame000011"],
    ),
    "easymocap": (write_easymocap, 0, ["00_000000", "00_000001", "00_000002"]),
    "opencv": (partial(write_easymocap, own=False, rotations=False), 0, ["00_000000", "00_000001", "00_000002"]),
    "actors_hq": (write_actors_hq, 1, ["Cam014_rgb000015", "Cam014_rgb000016", "Cam014_rgb000017"]),
}
"""Writer, held-out camera and its frames."""


@pytest.mark.parametrize("layout", LAYOUTS)
def test_cameras_times_and_split(tmp_path, layout):
    write, held, names = LAYOUTS[layout]
    write(tmp_path)
    train, test, val = (load(tmp_path, split) for split in ("train", "test", "val"))
    assert share_found(train, 0.12) > 0.75 and share_found(test, 0.12) > 0.75  # JPEG; some hide
    assert [frame.name for frame in test.entries] == names == [frame.name for frame in val.entries]
    assert train.times.tolist() == [0.0, 0.5, 1.0] * (CAMERAS - 1) and test.times.tolist() == [0.0, 0.5, 1.0]
    np.testing.assert_allclose(test.cameras[0].viewmat, viewmat(held, STEP), atol=1e-5)
    if layout in ("multipleview", "colmap", "stream"):
        np.testing.assert_allclose(train.points, POINTS, atol=1e-6)


def test_one_instant_of_a_rig_is_no_film(tmp_path):
    """All its images are of one moment, though each has a name of its own."""
    write_instants(tmp_path)
    data = load(tmp_path / "colmap_10")
    assert set(data.times.tolist()) == {0.0}
    assert [note for note in data.notes if f"--data {tmp_path} for all instants" in note]
    for other in ("colmap_9", "colmap_11"):
        (tmp_path / other).rename(tmp_path / f"x{other}")
    assert len(set(load(tmp_path / "colmap_10").times.tolist())) > 1, "a folder of this name may be a film"


def test_frames_of_each_camera_beside_the_instants(tmp_path):
    """SpacetimeGaussians first unpacks the videos beside ``poses_bounds.npy``, more of them than it has instants."""
    write_poses_bounds(tmp_path, inner=".")
    write_instants(tmp_path)
    assert load(tmp_path, "test").entries[0].name == "cam00_0000"
    for folder in tmp_path.glob("cam*"):
        folder.rename(tmp_path / f"_{folder.name}")
    assert load(tmp_path, "test").entries[0].name == "cam00_colmap_9"


def test_chosen_cameras_and_instants(tmp_path):
    write_actors_hq(tmp_path)
    given = {"only_cameras": "Cam013,Cam015,Cam016", "frames": "1:"}
    assert [frame.name for frame in load(tmp_path, "test", **given)] == ["Cam013_rgb000016", "Cam013_rgb000017"]
    assert load(tmp_path, **given).times.tolist() == [0.0, 1.0] * 2


@pytest.mark.parametrize(
    ("layout", "image"),
    [
        ("multipleview", "cam03/frame_00002.jpg"),
        ("colmap", "colmap_10/images/cam02.png"),
        ("stream", "frame000010/images/cam02.png"),
        ("easymocap", "images/02/000001.jpg"),
        ("actors_hq", "rgbs/Cam015/Cam015_rgb000016.jpg"),
    ],
)
def test_missing_images_leave_a_gap(tmp_path, layout, image):
    LAYOUTS[layout][0](tmp_path)
    (tmp_path / image).unlink()
    train = load(tmp_path)
    assert len(train) == 8 and {0.0, 1.0} <= set(train.times.tolist()) and share_found(train, 0.12) > 0.75
    assert any("1 of 9 frames are left out, because their images are missing" in note for note in train.notes)


def test_optimised_cameras_count(tmp_path):
    """They replace those of the calibration."""
    write_easymocap(tmp_path)
    (tmp_path / "optimized").mkdir()
    for name in ("intri.yml", "extri.yml"):
        (tmp_path / name).rename(tmp_path / "optimized" / name)
        (tmp_path / name).write_text("")
    assert share_found(load(tmp_path), 0.12) > 0.75


def test_reduced_images(tmp_path):
    """A camera that states its size tells how much smaller the images are."""
    write_easymocap(tmp_path / "a", own=False)
    write_actors_hq(tmp_path / "b")
    for path in tmp_path.rglob("*.jpg"):
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (WIDTH // 2, HEIGHT // 2)))
    for folder in ("a", "b"):
        camera = load(tmp_path / folder)[0].camera
        np.testing.assert_allclose([float(camera.K[0, 0]), float(camera.K[1, 2])], [FOCAL / 2, 31.0 / 2], rtol=1e-6)


def rewritten(path: str, old: str, new: str):
    def fault(folder: Path) -> None:
        text = (folder / path).read_text()
        assert old in text
        (folder / path).write_text(text.replace(old, new, 1))

    return fault


def mirrored(folder: Path) -> None:
    before, _, after = (folder / "extri.yml").read_text().partition("Rot_00")
    (folder / "extri.yml").write_text(f"{before}Rot_00{after.replace('data: [', 'data: [1', 1)}")


def one_camera(folder: Path) -> None:
    for path in folder.glob("cam0[2-9]"):
        path.rename(folder / path.name[3:])


def halved(folder: Path) -> None:
    for path in folder.rglob("*.jpg"):
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (WIDTH // 2, HEIGHT // 2)))


def without_images(folder: Path) -> None:
    for path in folder.rglob("*.jpg"):
        path.unlink()


FAULTS = {
    "no yaml": (write_easymocap, noise("intri.yml"), "intri.yml: cannot be read as text"),
    "no names": (write_easymocap, rewritten("intri.yml", "names", "nomes"), "names is missing or empty"),
    "way out": (write_easymocap, rewritten("intri.yml", '"01"', '"../x"'), "'../x', no name of a folder"),
    "no K": (write_easymocap, rewritten("intri.yml", "K_01", "K_x1"), "intri.yml: K_01 is missing"),
    "words": (write_easymocap, rewritten("intri.yml", "90.000000", "wide"), "K_00 is missing, or no 9 finite"),
    "nan": (write_easymocap, rewritten("intri.yml", "90.000000", "nan"), "K_00 is missing, or no 9 finite"),
    "focal": (write_easymocap, rewritten("intri.yml", "90.000000", "-90.0"), "K_00 is not a 3 x 3 matrix"),
    "no data": (write_easymocap, rewritten("extri.yml", "data:", "dota:"), "has no data"),
    "pose": (write_easymocap, mirrored, "Rot_00 is no rotation"),
    "smaller": (write_easymocap, halved, "principal point is (38, 31), far from the centre"),
    "videos": (write_easymocap, without_images, "images of 0 of 4 cameras are there"),
    "undecodable": (write_easymocap, noise("images/02/000001.jpg"), "000001.jpg: not an image"),
    "no column": (write_actors_hq, rewritten("calibration.csv", "rx", "r"), "has no column rx"),
    "short row": (write_actors_hq, rewritten("calibration.csv", "Cam014,80,", "Cam014,"), "row 3 is not a name and"),
    "infinite": (write_actors_hq, rewritten("calibration.csv", "Cam014,80", "Cam014,inf"), "row 3 holds NaN"),
    "no size": (write_actors_hq, rewritten("calibration.csv", "Cam014,80", "Cam014,0"), "that is not positive"),
    "other size": (write_actors_hq, rewritten("calibration.csv", "Cam014,80", "Cam014,81"), "is of 81 x 60 pixels"),
    "elsewhere": (write_actors_hq, rewritten("calibration.csv", "Cam014", "../Cam014"), "row 3 has no name of its"),
    "twice": (write_actors_hq, rewritten("calibration.csv", "Cam014", "Cam013"), "row 3 has no name of its own"),
    "damaged": (write_instants, noise("colmap_9/sparse/0/images.bin"), "images.bin: truncated or damaged"),
    "one": (write_multipleview, one_camera, "images of 1 of 4 cameras"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named(tmp_path, fault):
    write, edit, expected = FAULTS[fault]
    write(tmp_path)
    edit(tmp_path)
    split = "test" if fault == "other size" else "train"
    assert expected in message(tmp_path, split)


def test_masks_of_actors_hq_cut_out(tmp_path):
    write_actors_hq(tmp_path)
    assert not load(tmp_path).with_alpha  # masks that are white everywhere
    for file in tmp_path.glob("masks/*/*.png"):
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[:, WIDTH // 2 :] = 255
        assert cv2.imwrite(str(file), mask)
    for split in ("train", "test"):
        data = load(tmp_path, split)
        assert len(data.with_alpha) == len(data)
        alpha = data[0].alpha
        assert alpha is not None and not alpha[:, : WIDTH // 2].any() and alpha[:, WIDTH // 2 :].all()
    assert cv2.imwrite(str(file), mask[:, :HEIGHT])
    with pytest.raises(UserError, match=r"is 60 x 60 pixels, but its image Cam\S+ 80 x 60; give it the proportions"):
        [load(tmp_path, split) for split in ("train", "test")]
    file.unlink()
    data = load(tmp_path)
    assert not data.with_alpha and any(
        "1 of 12 images have no mask; no image is cut out" in note for note in data.notes
    )


@pytest.mark.parametrize("write", [write_multipleview, write_poses_bounds])
def test_the_camera_that_is_named_first_is_held_out(tmp_path, write):
    """Of Technicolor's 16 cameras, papers hold out one in the middle."""
    write(tmp_path)
    names = sorted({frame.name[:5] for split in ("train", "test") for frame in load(tmp_path, split)})
    assert {frame.name[:5] for frame in load(tmp_path, "test")} == {names[0]}
    chosen = ",".join([names[2], names[0], names[1]])
    assert {frame.name[:5] for frame in load(tmp_path, "test", only_cameras=chosen)} == {names[2]}
    assert {frame.name[:5] for frame in load(tmp_path, "train", only_cameras=chosen)} == set(names[:2])
