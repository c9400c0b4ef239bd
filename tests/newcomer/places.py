"""The working folder of a newcomer, and the flaws that a mistake needs in it."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from helpers.edit_scripts import SCRIPT
from helpers.layouts import write_colmap
from helpers.nerfstudio_files import write
from helpers.tiny import write_dnerf

TINY = (
    "--preset cpu --steps 20 --nodes 16 --device cpu --set init_points=300 "
    "--set motion.layers=3 --set motion.width=32 --set motion.skip=2"
)
"""Options of a run of a few steps."""


def write_data(place: Path) -> None:
    """Write the data sets that every mistake finds."""
    (place / "runs").mkdir(parents=True)
    write_dnerf(place / "data/blobs")
    write(place / "data/room")


def settle(place: Path) -> None:
    """Let the run name the data of this folder, after the folder has been copied."""
    path = place / "runs/blobs/config.json"
    content = json.loads(path.read_text())
    content["data"]["folder"] = str((place / "data/blobs").resolve())
    path.write_text(json.dumps(content, indent=2, sort_keys=True))


def change_transforms(place: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Apply ``change`` to the content of the room's transforms.json."""
    path = place / "data/room/transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def nothing(place: Path) -> None:
    pass


def empty(place: Path) -> None:
    (place / "data/empty").mkdir()


def film(place: Path) -> None:
    import av

    with av.open(str(place / "film.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for level in range(5):
            picture = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 40 * level, np.uint8), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def zipped(place: Path) -> None:
    with zipfile.ZipFile(place / "scene.zip", "w") as archive:
        archive.write(place / "data/room/transforms.json", "room/transforms.json")


def splats(place: Path) -> None:
    """Write a file with the header of a splat file."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    header = ["ply", "format ascii 1.0", "element vertex 1", *(f"property float {name}" for name in names)]
    (place / "cloud.ply").write_text("\n".join([*header, "end_header", " ".join(["0"] * 10 + ["1", "0", "0", "0"])]))


def photos(place: Path) -> None:
    (place / "photos").mkdir()
    for file in (place / "data/room").glob("*.png"):
        shutil.copy(file, place / "photos")


def nested(place: Path) -> None:
    shutil.copytree(place / "data/room", place / "outer/inner/room")


def some_missing(place: Path) -> None:
    for index in (3, 4, 7):
        (place / f"data/room/f_{index}.png").unlink()


def most_missing(place: Path) -> None:
    for index in range(12):
        (place / f"data/room/f_{index}.png").unlink()


def upper_case(place: Path) -> None:
    for file in (place / "data/room").glob("*.png"):
        file.rename(file.with_suffix(".PNG"))


def backslashes(place: Path) -> None:
    room = place / "data/room"
    (room / "images").mkdir()
    for file in room.glob("*.png"):
        file.rename(room / "images" / file.name)
    change_transforms(
        place, lambda content: [f.update(file_path="images\\" + f["file_path"]) for f in content["frames"]]
    )


def foreign_paths(place: Path) -> None:
    change_transforms(
        place, lambda content: [f.update(file_path="C:/Users/me/" + f["file_path"]) for f in content["frames"]]
    )


def byte_order_mark(place: Path) -> None:
    path = place / "data/room/transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())


def comma(place: Path) -> None:
    path = place / "data/room/transforms.json"
    path.write_text(path.read_text()[:-1] + ",}")


def lfs(place: Path) -> None:
    text = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 1234\n"
    for file in (place / "data/room").glob("*.png"):
        file.write_text(text)


def web_page(place: Path) -> None:
    (place / "data/room/f_0.png").write_text("<!DOCTYPE html>\n<html><head><title>Sign in</title></head></html>\n")


def cut_off(place: Path) -> None:
    path = place / "data/room/f_0.png"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def resized(place: Path) -> None:
    for file in (place / "data/room").glob("*.png"):
        image = cv2.imread(str(file))
        cv2.imwrite(str(file), cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2)))


def seconds(place: Path) -> None:
    change_transforms(place, lambda content: [f.update(time=10 * f["time"]) for f in content["frames"]])


def few_times(place: Path) -> None:
    change_transforms(place, lambda content: content["frames"][5].pop("time"))


def scaled_pose(place: Path) -> None:
    def scale(content: dict[str, Any]) -> None:
        for row in content["frames"][2]["transform_matrix"][:3]:
            row[:3] = [2 * x for x in row[:3]]

    change_transforms(place, scale)


def no_lens(place: Path) -> None:
    change_transforms(place, lambda content: [content.pop(key) for key in ("fl_x", "cx", "cy", "w", "h")])


def opencv_poses(place: Path) -> None:
    """Replace OpenGL's camera axes by those of OpenCV."""

    def turn(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            pose = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
            frame["transform_matrix"] = pose.tolist()

    change_transforms(place, turn)


def no_test_split(place: Path) -> None:
    (place / "data/blobs/transforms_test.json").unlink()
    shutil.rmtree(place / "data/blobs/test")


def colmap_alone(place: Path) -> None:
    write_colmap(place / "data/model")
    shutil.rmtree(place / "data/model/images")


def moved(place: Path) -> None:
    (place / "data/blobs").rename(place / "data/elsewhere")


def other_scene(place: Path) -> None:
    """Write an edit whose points lie far outside the scene of ``runs/blobs``."""
    far = [60.0, -40.0, 25.0]
    handle = {"name": "hand", "nodes": {"point": far, "rings": 1}}
    keyframes = [{"at": 0.0, "targets": {}}, {"at": 0.5, "targets": {"hand": {"translation": [0, 0, 1]}}}]
    content = {key: SCRIPT[key] for key in ("format", "version")}
    content |= {"handles": [handle], "keyframes": keyframes, "film": {"seconds": 0.5, "fps": 8, "size": 40}}
    (place / "edit.json").write_text(json.dumps(content))
