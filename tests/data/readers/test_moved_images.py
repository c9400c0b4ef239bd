"""Images that are not where the data set says: of another machine, another folder, or under an address."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.data_faults import message
from helpers.dnerf_files import edit, write_scene
from helpers.layouts import write_colmap
from helpers.nerfstudio_files import HEIGHT, WIDTH, save, write
from scgs_warp.data import load


def in_images(folder: Path, written: str, count: int = 10) -> dict:
    """Write a data set whose images are in ``images``, under names of the form ``written``."""
    content = write(folder, count)
    (folder / "images").mkdir()
    for entry in content["frames"]:
        (folder / entry["file_path"]).rename(folder / "images" / entry["file_path"])
        entry["file_path"] = written.format(entry["file_path"])
    save(folder, content)
    return content


@pytest.mark.parametrize(
    "written",
    [
        "/content/drive/My Drive/scene/images/{}",
        "C:\\Users\\me\\scene\\images\\{}",
        "../data/fox/images/{}",
        "./data/nerf/fox/images/{}",
        "file:///home/me/my%20scene/images/{}",
        "{}",
        "IMAGES/{}",
    ],
)
def test_images_are_found_below_the_folder(tmp_path, written):
    """instant-ngp's names are relative to the folder in which its script ran."""
    in_images(tmp_path, written)
    data = load(tmp_path)
    assert [frame.name for frame in data][:3] == ["f_0", "f_1", "f_2"] and len(data) == 9
    assert any(note.endswith(f"images are taken from {tmp_path / 'images'}") for note in data.notes)
    content = in_images(tmp_path / "lists", written)
    names = [entry["file_path"] for entry in content["frames"]]
    save(tmp_path / "lists", {**content, "train_filenames": names[:6], "test_filenames": names[6:]})
    assert [frame.name for frame in load(tmp_path / "lists", "test")] == ["f_6", "f_7", "f_8", "f_9"]


def test_names_with_escapes(tmp_path):
    content = write(tmp_path)
    for index, entry in enumerate(content["frames"]):
        (tmp_path / entry["file_path"]).rename(tmp_path / f"my film {index}.png")
        entry["file_path"] = f"my%20film%20{index}.png"
    save(tmp_path, content)
    assert load(tmp_path)[1].name == "my film 1"


def test_masks_and_depth_maps_move_with_the_images(tmp_path):
    content = in_images(tmp_path, "/data/scene/images/{}")
    (tmp_path / "maps").mkdir()
    np.save(tmp_path / "maps/d.npy", np.full((HEIGHT, WIDTH), 4.0, np.float32))
    mask = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    mask[:, :9] = 0
    cv2.imwrite(str(tmp_path / "maps/m.png"), mask)
    for entry in content["frames"]:
        entry.update(mask_path="/data/scene/maps/m.png", depth_file_path="/data/scene/maps/d.npy")
    save(tmp_path, {**content, "depth_unit_scale_factor": 1.0})
    data = load(tmp_path)
    mask_of_first, depth = data[0].mask, data.depth(0)
    assert mask_of_first is not None and not mask_of_first[:, :9].any() and depth is not None
    assert float(depth[0, 20]) == 4.0


def test_images_of_other_cameras_are_not_taken(tmp_path):
    """Names that differ in their folder alone would get one image."""
    content = in_images(tmp_path, "{}")
    for index, entry in enumerate(content["frames"]):
        entry["file_path"] = f"cam{index % 2}/f_{index // 2}.png"
    save(tmp_path, content)
    assert "images of 10 of 10 frames are missing" in message(tmp_path)


def test_names_that_lead_out_are_refused_unless_their_images_are_inside(tmp_path):
    write(tmp_path / "elsewhere")
    content = in_images(tmp_path / "scene", "../elsewhere/{}")
    shutil.rmtree(tmp_path / "scene/images")
    assert "leads out of" in message(tmp_path / "scene")
    for entry in content["frames"]:
        entry["file_path"] = entry["file_path"].replace("..", "/nowhere")
    save(tmp_path / "scene", content)
    assert "a path of another machine" in message(tmp_path / "scene")


def test_names_of_dnerf(tmp_path):
    write_scene(tmp_path / "s")
    edit(
        tmp_path / "s",
        lambda content: [
            entry.update(file_path=entry["file_path"].replace("./", "/blender/")) for entry in content["frames"]
        ],
    )
    assert len(load(tmp_path / "s")) == 3


@pytest.mark.parametrize("written", ["images/{}", "/home/me/images/{}", "C:\\scans\\images\\{}", "{}"])
@pytest.mark.parametrize("place", ["images", "rgb", "input"])
def test_names_of_colmap(tmp_path, written, place):
    """COLMAP names images relative to a folder of its user's choice."""
    write_colmap(tmp_path, text=True, names=lambda index: f"{index:03d}.png")
    model = tmp_path / "sparse/0/images.txt"
    model.write_text(re.sub(r"(\d{3}\.png)", lambda found: written.format(found[1]), model.read_text()))
    if place != "images":
        (tmp_path / "images").rename(tmp_path / place)
    data = load(tmp_path)
    assert len(data) == 12 and data.times.max() == 1
