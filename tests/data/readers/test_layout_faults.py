"""What is wrong with data of each layout is said in one line that names file, field and remedy; damage never hangs."""

from __future__ import annotations

import io
import json
import struct
import time
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from helpers.layouts import HEIGHT, WIDTH, save_image, write_colmap, write_nerfies, write_panoptic, write_poses_bounds
from helpers.nerfstudio_files import write as write_nerfstudio
from scgs_warp.data import load
from scgs_warp.data.readers.colmap_model import read_model
from scgs_warp.errors import UserError
from scgs_warp.storage.numpy_files import read_npy

NAN = float("nan")


def message(folder: Path, split: str = "train") -> str:
    with pytest.raises(UserError) as caught:
        load(folder, split)
    text = str(caught.value)
    assert "\n" not in text and str(folder) in text and "; " in text, text
    return text


def change(path: Path, edit) -> None:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def put(path: str, *keys, value):
    """A fault: this value at that place of a JSON file; ``...`` removes it."""

    def edit(content) -> None:
        for key in keys[:-1]:
            content = content[key]
        if value is ...:
            del content[keys[-1]]
        else:
            content[keys[-1]] = value

    return lambda folder: change(folder / path, edit)


def text(path: str, content: str):
    return lambda folder: (folder / path).write_text(content)


def gone(path: str):
    return lambda folder: (folder / path).unlink()


def noise(path: str):
    return lambda folder: (folder / path).write_bytes(b"\x89PNG\r\n\x1a\n broken")


def small(path: str):
    return lambda folder: save_image(folder / path, np.zeros((HEIGHT - 20, WIDTH - 20, 3), np.uint8))


CAMERA = "camera/000003.json"
IMAGE = "rgb/1x/000003.png"
NERFIES = {
    "no json": (text("dataset.json", "{"), "dataset.json: not valid JSON"),
    "a list": (text("dataset.json", "[]"), "dataset.json: holds no JSON object"),
    "no ids": (text("dataset.json", "{}"), "ids, train_ids and val_ids are missing"),
    "ids": (put("dataset.json", "train_ids", value="all"), "train_ids is no list"),
    "outside": (put("dataset.json", "train_ids", value=["../../x"]), "train_ids holds '../../x'"),
    "nothing left": (put("dataset.json", "train_ids", value=["000002"]), "train_ids are all among val_ids"),
    "no camera": (gone(CAMERA), "000003.json: no such file"),
    "no image": (gone(IMAGE), "000003.png: no such image"),
    "undecodable": (noise(IMAGE), "000003.png: not an image"),
    "size": (small(IMAGE), "image_size is 80 x 60, but the images in rgb/1x are 60 x 40"),
    "no time": (put("metadata.json", "000003", value=...), "000003.warp_id is missing"),
    "time": (put("metadata.json", "000003", "warp_id", value="late"), "000003.warp_id is missing or no number"),
    "nan": (put(CAMERA, "position", value=[0, NAN, 0]), "position is not three finite"),
    "rotation": (put(CAMERA, "orientation", value=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]), "orientation is no rotation"),
    "nan rotation": (put(CAMERA, "orientation", 1, 1, value=NAN), "orientation is no rotation"),
    "focal": (put(CAMERA, "focal_length", value=...), "focal_length"),
    "negative": (put(CAMERA, "focal_length", value=-3), "focal_length"),
    "centre": (put(CAMERA, "principal_point", value=[1]), "principal_point"),
    "radial": (put(CAMERA, "radial_distortion", value=["a", 0, 0]), "radial_distortion must be three numbers"),
    "huge radial": (put(CAMERA, "radial_distortion", value=[1e300, 0, 0]), "not finite"),
    "image size": (put(CAMERA, "image_size", value=[0, 0]), "image_size is not two positive"),
    "scale": (put("scene.json", "scale", value=0), "scale is missing or no positive"),
    "scene": (put("scene.json", "center", value=[0, 0]), "center is missing or not three"),
    "points": (noise("points.npy"), "points.npy: no sound numpy file"),
    "shape": (lambda folder: np.save(folder / "points.npy", np.zeros((3, 4))), "points.npy: has shape [3, 4]"),
    "objects": (lambda folder: np.save(folder / "points.npy", [{}], allow_pickle=True), "points.npy: no sound"),
}
META = "train_meta.json"
PANOPTIC = {
    "no json": (text(META, "{]"), "train_meta.json: not valid JSON"),
    "no files": (put(META, "fn", value=...), "fn is missing"),
    "files": (put(META, "fn", 0, 0, value=3), "fn[0][0] is no text"),
    "rows": (put(META, "k", value=[1, 2]), "k is missing or no list of lists"),
    "count": (put(META, "w2c", 2, value=[]), "w2c and fn list different numbers"),
    "instants": (put(META, "k", value=[[]]), "k and fn list different numbers"),
    "nothing": (lambda folder: change(folder / META, lambda c: c.update(fn=[], k=[], w2c=[])), "fn lists no frame"),
    "pose": (put(META, "w2c", 1, 2, 0, 3, value=NAN), "w2c[1][2] is no rigid"),
    "mirrored": (put(META, "w2c", 1, 2, value=np.diag([1.0, 1, -1, 1]).tolist()), "w2c[1][2] is no rigid"),
    "camera": (put(META, "k", 1, 2, 0, 0, value=-5), "k[1][2] is no 3 x 3 matrix"),
    "width": (put(META, "w", value=99), "w is 99, but the images are 80 x 60"),
    "no image": (gone("ims/1/000002.jpg"), "000002.jpg: no such image"),
    "undecodable": (noise("ims/1/000002.jpg"), "000002.jpg: not an image"),
    "points": (noise("init_pt_cld.npz"), "init_pt_cld.npz: no sound numpy file"),
    "no data": (lambda folder: np.savez(folder / "init_pt_cld.npz", points=1), "no array named 'data'"),
    "shape": (lambda folder: np.savez(folder / "init_pt_cld.npz", data=np.zeros(3)), "data has shape [3]"),
}


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


BOUNDS = {
    "damaged": (noise("poses_bounds.npy"), "poses_bounds.npy: no sound"),
    "shape": (bounds(lambda rows: rows[:, :15]), "has shape [4, 15]"),
    "rows": (bounds(lambda rows: rows[:3]), "has 3 rows, but"),
    "nan": (entry(1, 0, NAN), "row 1 holds no rotation"),
    "scaled": (entry(2, 0, 5.0), "row 2 holds no rotation"),
    "focal": (entry(1, 14, 0.0), "row 1 has no positive"),
    "aspect": (entry(1, 9, 300.0), "row 1 is of 300 x 60 pixels, but the images are 80 x 60"),
    "one camera less": (gone("cam01/images/0002.png"), "cam01/images: holds 2 images, but images 3"),
    "undecodable": (noise("cam01/images/0001.png"), "0001.png: not an image"),
}


def model_text(file: str, edit):
    def fault(folder: Path) -> None:
        path = folder / "sparse/0" / file
        path.write_text("".join(edit(path.read_text().splitlines(keepends=True))))

    return fault


def words(line: int, place: int, value: str):
    def edit(lines: list[str]) -> list[str]:
        data = [index for index, content in enumerate(lines) if not content.startswith("#")][line]
        parts = lines[data].split()
        parts[place] = value
        lines[data] = " ".join(parts) + "\n"
        return lines

    return edit


COLMAP = {
    "nan": (model_text("images.txt", words(0, 2, "nan")), "images.txt: the pose of 'frame_1.png'"),
    "quaternion": (model_text("images.txt", words(0, 2, "7.0")), "images.txt: the pose of 'frame_1.png'"),
    "no number": (model_text("images.txt", words(0, 2, "x")), "images.txt: truncated or damaged"),
    "camera": (model_text("images.txt", words(0, 8, "3")), "frame_1.png is of camera 3, which cameras.txt does"),
    "outside": (
        model_text("images.txt", words(0, 9, "../f.png")),
        "name of an image is '../f.png', which leads out",
    ),
    "truncated": (model_text("images.txt", lambda lines: lines[:-1]), "its line of observations is missing"),
    "empty": (text("sparse/0/images.txt", "# nothing\n"), "no image is registered"),
    "model": (model_text("cameras.txt", words(0, 1, "PLATE")), "camera '7' is of no model that is known"),
    "params": (model_text("cameras.txt", words(0, 1, "OPENCV")), "camera '7' has 4 parameters, but OPENCV"),
    "focal": (model_text("cameras.txt", words(0, 4, "-3")), "the focal length is not positive"),
    "size": (model_text("cameras.txt", words(0, 2, "81")), "is of 81 x 60 pixels, but the image is 80 x 60"),
    "binary": (lambda folder: (folder / "sparse/0/images.txt").write_bytes(b"\xff\xfe\x80"), "truncated or damaged"),
    "points": (model_text("points3D.txt", words(0, 2, "far")), "points3D.txt: truncated or damaged"),
    "no image": (gone("images/frame_3.png"), "frame_3.png: no such image, though the model has it (1 of 14"),
    "undecodable": (noise("images/frame_3.png"), "frame_3.png: not an image"),
}
ALL = {"nerfies": (write_nerfies, NERFIES), "panoptic": (write_panoptic, PANOPTIC)}
ALL |= {"bounds": (write_poses_bounds, BOUNDS), "colmap": (lambda folder: write_colmap(folder, text=True), COLMAP)}


@pytest.mark.parametrize(("layout", "fault"), [(layout, fault) for layout in ALL for fault in ALL[layout][1]])
def test_faults_are_named(tmp_path, layout, fault):
    writer, faults = ALL[layout]
    writer(tmp_path)
    edit, expected = faults[fault]
    edit(tmp_path)
    assert expected in message(tmp_path)


def test_splits_that_are_not_there(tmp_path):
    write_panoptic(tmp_path)
    (tmp_path / "test_meta.json").unlink()
    assert "test_meta.json: no such file" in message(tmp_path, "test")
    folder = tmp_path / "one"
    write_colmap(folder, count=1)
    assert "one frame cannot be both" in message(folder)


def test_nothing_known(tmp_path):
    text = message(tmp_path)
    names = (
        "transforms_train.json",
        "transforms.json",
        "dataset.json",
        "train_meta.json",
        "poses_bounds.npy",
        "sparse/0",
    )
    assert all(name in text for name in names)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("layout", [*ALL, "nerfstudio"])
def test_mutated_files_are_read_or_refused(tmp_path, layout, seed):
    """Whatever bytes change: a data set, or one line; soon, and without the memory that a damaged count asks for."""
    random = np.random.default_rng(seed)
    folder = tmp_path / "scene"
    {"colmap": write_colmap, "nerfstudio": write_nerfstudio}.get(layout, ALL.get(layout, (None,))[0])(folder)
    files = sorted(f for f in folder.rglob("*") if f.is_file() and f.suffix not in (".png", ".jpg"))
    original = {file: file.read_bytes() for file in files}
    for _ in range(12):
        file = files[random.integers(len(files))]
        data = bytearray(original[file])
        if random.random() < 0.3:
            data = data[: random.integers(len(data))]
        else:
            for _ in range(4):
                data[random.integers(min(len(data), 300))] = random.integers(256)
        file.write_bytes(data)
        began = time.monotonic()
        tracemalloc.start()
        try:
            load(folder)
        except UserError as error:
            assert "\n" not in str(error)
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert time.monotonic() - began < 20 and peak < 100e6
        file.write_bytes(original[file])


@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
def test_binary_counts_are_not_believed(tmp_path, file):
    write_colmap(tmp_path)
    path = tmp_path / f"sparse/0/{file}.bin"
    data = path.read_bytes()
    for count in (2**63, 10**9, len(data)):
        path.write_bytes(struct.pack("<Q", count) + data[8:])
        with pytest.raises(UserError, match=rf"{file}\.bin: truncated or damaged"):
            read_model(path.parent)
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        with pytest.raises(UserError, match=rf"{file}\.bin"):
            read_model(path.parent)


def test_arrays_that_claim_more_than_they_hold(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)})
    (tmp_path / "a.npy").write_bytes(header.getvalue() + bytes(240))
    with pytest.raises(UserError, match=r"a\.npy: no sound numpy file"):
        read_npy(tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("data.npy", header.getvalue() + bytes(240))
    with pytest.raises(UserError, match=r"a\.npz: no sound numpy file"):
        read_npy(tmp_path / "a.npz", "data")
    for array in (np.arange(6, dtype=np.int32).reshape(2, 3), np.asfortranarray(np.eye(3, dtype=np.float32)[:2])):
        np.save(tmp_path / "b.npy", array)
        np.testing.assert_array_equal(read_npy(tmp_path / "b.npy"), array)
