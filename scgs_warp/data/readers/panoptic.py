"""Reader of the layout of Dynamic 3D Gaussians, used for the CMU Panoptic sequences: many cameras with shared times.

``train_meta.json`` and ``test_meta.json``: ``w, h``; ``fn [T][C]``, images in ``ims/``; ``k [T][C][3][3]``, pixels;
``w2c [T][C][4][4]``, world-to-camera, OpenCV; ``cam_id [T][C]``. ``init_pt_cld.npz``: ``data [P, 7]``, positions,
colours in [0, 1], foreground. ``seg/`` separates people from the dome and is ignored. Layout: Luiten et al., 3DV 2024.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import UserError
from ...geometry.rotation import is_rotation
from ...storage.json_files import as_array, as_number, read_json
from ...storage.numpy_files import read_npy
from ...storage.safe_paths import first_there, inside
from ..assemble import FrameRecord, assemble, with_points
from ..choice import choose
from ..dataset import Dataset
from ..images import ReadOptions, size_text
from ..lens import Lens

TRAIN, TEST = "train_meta.json", "test_meta.json"
POINTS = "init_pt_cld.npz"


def recognises(folder: Path) -> bool:
    """Return whether the folder holds this layout."""
    return (folder / TRAIN).is_file() or (folder / TEST).is_file()


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split: the cameras of ``train_meta.json``, or of ``test_meta.json`` for ``test`` and ``val``.

    All cameras of an instant share its time; instants are evenly spaced in the order of the list. The camera of a frame
    is the folder of its image; ``only_cameras`` restricts the training cameras alone.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    path = folder / (TRAIN if split == "train" else TEST)
    content = read_json(path, "this split needs it, or choose another split")
    rows = {key: _rows(path, content, key) for key in ("fn", "k", "w2c")}
    files, last = rows["fn"], max(len(rows["fn"]) - 1, 1)
    records = []
    for instant, names in enumerate(files):
        for key in ("k", "w2c"):
            if len(rows[key]) != len(files) or len(rows[key][instant]) != len(names):
                raise UserError(f"{path}: {key} and fn list different numbers of frames; give every image one of each")
        for number, name in enumerate(names):
            where = f"[{instant}][{number}]"
            if not isinstance(name, str) or not name:
                raise UserError(f"{path}: fn{where} is not text; name the image file")
            viewmat = as_array(rows["w2c"][instant][number], (4, 4), (3, 4))
            if viewmat is None or not is_rotation(viewmat[:3, :3]):
                raise UserError(f"{path}: w2c{where} is not a rigid 4 x 4 matrix of finite numbers; correct the pose")
            K = as_array(rows["k"][instant][number], (3, 3))
            if K is None or K[0, 0] <= 0 or K[1, 1] <= 0 or np.abs(K[2] - (0, 0, 1)).max() > 1e-6:
                raise UserError(f"{path}: k{where} is not a 3 x 3 matrix of intrinsics in pixels; correct the camera")
            file = inside(folder / "ims", name, f"{path}: fn{where}", "image")
            file = first_there([file]) or file
            pose = np.vstack([viewmat[:3], (0.0, 0.0, 0.0, 1.0)])
            label = Path(name).with_suffix("").as_posix().replace("/", "_").strip("._")
            records.append(FrameRecord(file, pose, instant / last, partial(_lens, path, content, K), label))
    if not records:
        raise UserError(f"{path}: fn lists no frame; list at least one")
    cameras = [record.file.parent.name for record in records] if split == "train" else None
    choice = choose(path, [r.file for r in records], [r.time for r in records], options, cameras)
    chosen = [replace(records[index], time=choice.times[index]) for index in choice.indices]
    data = assemble(chosen, options, folder=folder, split=split, notes=choice.notes)
    return with_points(data, *_points(folder / POINTS))


def _rows(path: Path, content: dict[str, Any], key: str) -> list[list[Any]]:
    """Return the rows of field ``key``: per instant, one entry per camera."""
    rows = content.get(key)
    if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
        raise UserError(f"{path}: {key} is missing or not a list of lists; give one list of cameras for each instant")
    return rows


def _lens(path: Path, content: dict[str, Any], K: np.ndarray, source: tuple[int, int]) -> Lens:
    for key, actual in zip("wh", source):
        if key in content and as_number(content[key]) != actual:
            raise UserError(
                f"{path}: {key} is {str(content[key])[:20]}, but the images are {size_text(source)}; correct w and h "
                "together with k, or resize the images"
            )
    return Lens(K[0, 0], K[1, 1], K[0, 2], K[1, 2], skew=float(K[0, 1]))


def _points(path: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    if not path.is_file():
        return None, None
    cloud = read_npy(path, "data")
    if cloud.ndim != 2 or cloud.shape[1] < 3:
        raise UserError(f"{path}: data has shape {list(cloud.shape)}; give [P, 7], or remove the file")
    if cloud.shape[1] < 6:
        return cloud[:, :3], None
    return cloud[:, :3], np.nan_to_num(cloud[:, 3:6], nan=0.5).clip(0.0, 1.0)
