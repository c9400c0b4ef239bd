"""Choice of frames: missing images, --frames, --only-cameras, in every layout."""

from __future__ import annotations

import json

import pytest

from helpers.data_faults import message
from helpers.layouts import write_colmap, write_nerfies, write_panoptic, write_poses_bounds
from helpers.nerfstudio_files import save, write
from helpers.tiny import write_dnerf
from scgs_warp.data import load
from scgs_warp.errors import UserError

WRITERS = {
    "nerfies": (write_nerfies, "rgb/1x/000003.png", 12),
    "panoptic": (write_panoptic, "ims/1/000002.jpg", 15),
    "colmap": (write_colmap, "images/frame_3.png", 14),
    "nerfstudio": (write, "f_3.png", 20),
    "dnerf": (write_dnerf, "train/train_003.png", 8),
}


def names(data) -> list[str]:
    return [entry.name for entry in data.entries]


@pytest.mark.parametrize("layout", WRITERS)
def test_a_missing_image_leaves_its_frame_out(layout, tmp_path):
    writer, image, count = WRITERS[layout]
    folder = tmp_path / "scene"
    writer(folder)
    before = {entry.name: entry.time for entry in load(folder).entries}
    (folder / image).unlink()
    data = load(folder)
    (note,) = data.notes
    assert f"1 of {count} frames are left out, because their images are missing ({image.split('/')[-1]})" in note
    assert "\n" not in note and str(folder) in note
    lost = set(before) - set(names(data))
    assert len(lost) == (3 if layout in ("colmap", "nerfstudio") else 1), "every eighth of those left is held out"
    assert all(before[e.name] == e.time for e in data.entries if e.name in before), "times stay"


def test_half_of_the_images_is_enough_and_less_must_be_asked_for(tmp_path):
    write(tmp_path)
    for index in range(10):
        (tmp_path / f"f_{index}.png").unlink()
    assert len(load(tmp_path)) + len(load(tmp_path, "test")) == 10
    (tmp_path / "f_10.png").unlink()
    text = message(tmp_path)
    assert "the images of 11 of 20 frames are missing (f_0.png, f_1.png, f_2.png and 8 more)" in text
    assert text.endswith("restore them, or pass --min-frames 9 to use the other 9")
    assert len(load(tmp_path, min_frames=9)) + len(load(tmp_path, "test", min_frames=9)) == 9
    with pytest.raises(UserError, match="--min-frames 9"):
        load(tmp_path, min_frames=10)
    for index in range(11, 20):
        (tmp_path / f"f_{index}.png").unlink()
    with pytest.raises(UserError, match=r"20 of 20 frames are missing .*; restore them$"):
        load(tmp_path, min_frames=1)


def test_listed_splits_may_lose_frames_but_not_all(tmp_path):
    write(tmp_path, test_filenames=["f_1.png", "f_2.png"], train_filenames=[f"f_{i}.png" for i in range(3, 9)])
    (tmp_path / "f_1.png").unlink()
    assert names(load(tmp_path, "test")) == ["f_2"]
    (tmp_path / "f_2.png").unlink()
    assert "no frame of test_filenames is left" in message(tmp_path, "test")


def test_frames_are_chosen_by_instant_and_their_times_scaled(tmp_path):
    write(tmp_path)
    train, test = (load(tmp_path, split, frames="4:15:2") for split in ("train", "test"))
    assert names(test) == ["f_12"] and names(train) == ["f_4", "f_6", "f_8", "f_10", "f_14"]
    assert train.times.tolist() == pytest.approx([0, 0.2, 0.4, 0.6, 1.0]) and float(test.times) == pytest.approx(0.8)
    assert names(load(tmp_path, frames=":")) == names(load(tmp_path))
    assert names(load(tmp_path, frames="-6:")) == ["f_14", "f_15", "f_16", "f_17", "f_19"]
    for text, expected in {
        "90:": "chooses none of the 20 instants",
        "5": "write A:B or A:B:C",
        "1:2:0": "write A:B",
        "::-1": "write A:B",
        "a:b": "write A:B",
    }.items():
        with pytest.raises(UserError, match=expected):
            load(tmp_path, frames=text)


def test_frames_of_a_rig_are_instants_of_all_its_cameras(tmp_path):
    write_panoptic(tmp_path / "panoptic")
    train, test = (load(tmp_path / "panoptic", split, frames="1:4") for split in ("train", "test"))
    assert len(train) == 9 and len(test) == 3 and sorted(set(train.times.tolist())) == [0.0, 0.5, 1.0]
    write_poses_bounds(tmp_path / "bounds")
    assert len(load(tmp_path / "bounds", frames="::2")) == 6


def test_held_out_frames_of_a_file_of_their_own_lie_between_the_chosen_ones(tmp_path):
    folder = write_dnerf(tmp_path / "blobs")
    assert load(folder, "test").times.tolist() == [0.0, 0.5, 1.0]
    assert load(folder, "train", frames="2:6").times.tolist() == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert load(folder, "test", frames="2:6").times.tolist() == pytest.approx([0.5])
    with pytest.raises(UserError, match=r"no frame is of the instants that --frames 1:3 chooses"):
        load(folder, "test", frames="1:3")


def test_cameras_are_chosen_by_name(tmp_path):
    write_panoptic(tmp_path / "panoptic")
    train, test = (load(tmp_path / "panoptic", split, only_cameras="0, 2") for split in ("train", "test"))
    assert len(train) == 10 and len(test) == 5, "the held-out cameras stay"
    write_poses_bounds(tmp_path / "bounds")
    chosen = {"only_cameras": "cam01,cam03"}
    assert {n[:5] for n in names(load(tmp_path / "bounds", **chosen))} == {"cam03"}
    assert {n[:5] for n in names(load(tmp_path / "bounds", "test", **chosen))} == {"cam01"}
    write_nerfies(tmp_path / "nerfies")
    assert len(load(tmp_path / "nerfies", only_cameras="1")) == 5, "of 6 frames of one camera, one is held out"
    write_colmap(tmp_path / "colmap", names=lambda index: f"{'left' if index % 2 else 'right'}/{index}.png")
    assert all(name.startswith("left") for name in names(load(tmp_path / "colmap", only_cameras="left")))
    for layout, there in {"panoptic": "0, 1, 2", "colmap": "left, right", "bounds": "cam00, cam01"}.items():
        with pytest.raises(UserError, match=f"--only-cameras top: no frame is of this camera; choose of {there}"):
            load(tmp_path / layout, only_cameras="top")
    with pytest.raises(UserError, match="this layout does not name any"):
        load(write_dnerf(tmp_path / "blobs"), only_cameras="top")
    with pytest.raises(UserError, match="name two cameras or more"):
        load(tmp_path / "bounds", only_cameras="cam01")


def test_dnerf_without_test_frames_holds_out_every_eighth(tmp_path):
    folder = write_dnerf(tmp_path / "blobs")
    (folder / "transforms_test.json").rename(folder / "transforms_val.json")
    assert names(load(folder, "test")) == ["test_000", "test_001", "test_002"] and len(load(folder)) == 8
    (folder / "transforms_val.json").unlink()
    assert names(load(folder, "test")) == names(load(folder, "val")) == ["train_004"]
    assert "train_004" not in names(load(folder)) and len(load(folder)) == 7


def test_names_in_another_case_and_with_backslashes(tmp_path):
    content = write(tmp_path)
    (tmp_path / "Images").mkdir()
    for index in range(20):
        (tmp_path / f"f_{index}.png").rename(tmp_path / "Images" / f"F_{index}.PNG")
        content["frames"][index]["file_path"] = f"Images\\f_{index}"
    save(tmp_path, content)
    assert len(load(tmp_path)) == 18
    for name, expected in {
        "C:\\films\\f_0.png": "a path of another machine",
        "/home/somebody/f_0.png": "a path of another machine",
        "/etc/hostname": "leads out of",
    }.items():
        content["frames"][0]["file_path"] = name
        save(tmp_path, content)
        assert expected in message(tmp_path) and json.dumps(name)[1:-1] in message(tmp_path)
