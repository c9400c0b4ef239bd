"""Reader of the nerfstudio layout: one ``transforms.json`` for all frames, with intrinsics, poses and optional points.

``fl_x, fl_y, cx, cy, w, h`` (pixels; for all frames or in each), per frame ``file_path``, ``transform_matrix``
(camera-to-world, OpenGL), ``time`` in [0, 1] or else ``timestep_index`` or ``timestamp``, ``mask_path`` and
``depth_file_path`` (``depth_maps``), which instant-ngp calls ``depth_path``, with ``integer_depth_scale`` as its unit;
``ply_file_path``, sparse points in the frame of the poses, without which those of a COLMAP model beside it count
(``model_points``);
``train_filenames``, ``val_filenames``, ``test_filenames``; ``camera_model`` and ``k1`` ... ``k6, p1, p2``, or
``distortion_params``, for all frames or in each (images with distortion are undistorted).
Layout: Tancik et al., Nerfstudio, SIGGRAPH 2023.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ...errors import UserError
from ...storage.json_files import as_array, as_number
from ...storage.safe_paths import inside
from ...types import Camera
from ..assemble import FrameRecord, assemble, video_border, with_points
from ..choice import choose
from ..dataset import Dataset
from ..depth_maps import MILLIMETRE, DepthFile
from ..depth_points import points_of_depth
from ..far_origin import moved, note, offset_of
from ..held_out import held_out
from ..images import ReadOptions
from ..natural_order import by_name
from ..points import read_points
from .model_points import points_of_model
from .transforms import (
    Times,
    find_mask,
    moments_of,
    note_reduced,
    read_distortion,
    read_lens,
    read_pose,
    read_times,
    read_transforms,
)
from .transforms_images import find_foregrounds, find_images

FILE = "transforms.json"


def recognises(folder: Path) -> bool:
    """Return whether the folder holds this layout."""
    return (folder / FILE).is_file()


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split.

    Frames without times are evenly spaced in the order of their names (9 before 10). Without lists of files, every
    eighth frame is held out for ``test`` and ``val`` alike. If only one of the lists for ``test`` and ``val`` is
    present and not empty, it serves for both splits. A frame's mask is False where ``mask_path`` is black and on the
    borders of undistorted images. The camera of a frame is the folder of its image.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    path = folder / FILE
    content = read_transforms(path)
    located = find_images(path, folder, content["frames"])
    entries, files = located.entries, located.files
    times, scaled = _times(path, entries, files)
    for entry in entries:
        read_distortion(path, {**content, **entry})
    choice = choose(path, files, times, options, [file.relative_to(folder).parent.as_posix() for file in files])
    chosen = _of_split(path, content, files, choice.indices, split)
    poses = {index: read_pose(path, index, entries[index]) for index in choice.indices}
    offset = offset_of(list(poses.values()))
    if offset is not None:
        poses = {index: moved(pose, offset) for index, pose in poses.items()}
    records = [
        _record(path, folder, {**content, "frames": entries}, index, files[index], poses[index], choice.times[index])
        for index in chosen
    ]
    cut_out = find_foregrounds(path, folder, entries, chosen)
    records = [replace(record, cut_out_by=mask) for record, mask in zip(records, cut_out)]
    border = video_border([files[index] for index in choice.indices], [times[index] for index in choice.indices])
    first = choice.indices[0]
    smaller = note_reduced(path, {**content, **entries[first]}, files[first])
    notes = [*located.notes, *scaled, *choice.notes, *smaller, *([] if offset is None else [note(offset)])]
    named = sum(bool(entries[index].get(_depth_keys(content, entries[index])[0])) for index in chosen)
    notes += _of_depth(path, content) + _without_depth(path, named, records)
    data = assemble(records, options, folder=folder, split=split, one_size=True, border=border, notes=notes)
    points = _points(path, folder, content, data.cameras, np.zeros(3) if offset is None else offset)
    if points is None:
        points = points_of_model(folder, [files[index].name for index in poses], [*poses.values()])
    if points is None and split == "train" and not data.with_alpha:  # a cut-out subject is found without points
        points = points_of_depth(data, agreeing=True)
    return data if points is None else with_points(data, *points)


def _record(
    path: Path, folder: Path, content: dict[str, Any], index: int, file: Path, pose: np.ndarray, time: float
) -> FrameRecord:
    entry = content["frames"][index]
    fields = {**content, **entry}
    return FrameRecord(
        file,
        pose,
        time,
        partial(read_lens, path, fields, index),
        file.stem,
        find_mask(path, folder, index, entry),
        "w" in fields or "h" in fields,
        _depth(path, folder, content, index),
    )


def _depth(path: Path, folder: Path, content: dict[str, Any], index: int) -> DepthFile | None:
    """Return the depth map that a frame names; None without a name, or without such a file."""
    entry = content["frames"][index]
    key, unit_key = _depth_keys(content, entry)
    name = entry.get(key)
    if name is None or name == "":
        return None
    if not isinstance(name, str):
        raise UserError(f"{path}: frames[{index}].{key} is not text; name the depth map or leave it out")
    unit = as_number(content.get(unit_key, MILLIMETRE))
    if unit is None or unit <= 0.0:
        raise UserError(f"{path}: {unit_key} is no positive number; give the unit of the depth maps")
    file = inside(folder, name, f"{path}: frames[{index}].{key}", "depth map")
    return DepthFile(file, unit) if file.exists() else None


def _depth_keys(content: dict[str, Any], entry: dict[str, Any]) -> tuple[str, str]:
    """Return the field that names a frame's depth map, and the one that holds its unit: those of instant-ngp, which
    reads maps only if it has a unit, if the frame has none of nerfstudio's."""
    wanted = "integer_depth_scale" in content and content.get("enable_depth_loading") is not False
    if wanted and "depth_path" in entry and "depth_file_path" not in entry:
        return "depth_path", "integer_depth_scale"
    return "depth_file_path", "depth_unit_scale_factor"


def _of_depth(path: Path, content: dict[str, Any]) -> list[str]:
    """Return a note if depth maps of decimal numbers have no unit: nerfstudio takes them for millimetres."""
    names = [entry.get("depth_file_path") for entry in content["frames"]]
    decimal = any(isinstance(name, str) and name.lower().endswith((".npy", ".npz", ".exr")) for name in names)
    if not decimal or "depth_unit_scale_factor" in content:
        return []
    return [f"{path} has no depth_unit_scale_factor: depth maps are read as millimetres; give 1 if they are in metres"]


def _without_depth(path: Path, named: int, records: list[FrameRecord]) -> list[str]:
    """Return a note if some of the ``named`` depth maps of a split's frames are missing."""
    missing = named - sum(record.depth is not None for record in records)
    if missing == 0:
        return []
    return [f"{path}: {missing} of {named} depth maps are missing; their frames count as frames without one"]


def _times(path: Path, entries: list[dict[str, Any]], files: list[Path]) -> Times:
    if any(entry.get("time") is not None for entry in entries):
        return read_times(path, entries)
    moments = moments_of(files)
    last = max(len(set(moments)) - 1, 1)
    return Times([moment / last for moment in moments], ())


def _of_split(path: Path, content: dict[str, Any], files: list[Path], indices: list[int], split: str) -> list[int]:
    """Return those of the ascending ``indices`` that belong to this split."""
    lists = {name: content[f"{name}_filenames"] for name in ("train", "val", "test") if f"{name}_filenames" in content}
    for name in ("val", "test"):  # Exporters write all three lists, of which one may be empty.
        if lists.get(name) == []:
            del lists[name]
    if not lists:
        allowed = set(indices)
        return held_out(path, [index for index in by_name(files) if index in allowed], split)
    substitute = {"val": "test", "test": "val"}.get(split, split)
    name = split if split in lists else substitute
    if name not in lists:
        raise UserError(f"{path}: {split}_filenames is missing while other splits are listed; list the files there")
    listed = lists[name]
    if not isinstance(listed, list) or not listed or not all(isinstance(item, str) for item in listed):
        raise UserError(f"{path}: {name}_filenames is empty or not a list of file names; name at least one file")
    known = _Names([entry["file_path"] for entry in content["frames"]])
    for item in listed:
        if item not in known:
            raise UserError(
                f"{path}: {name}_filenames names {item!r}, which no frame has as file_path; write it as the frame does"
            )
    named = {known[item] for item in listed}
    if name == "train":  # what is held out is not trained on, though some exporters list all frames here
        others = [lists[other] for other in ("val", "test") if isinstance(lists.get(other), list)]
        held = {known[item] for other in others for item in other if isinstance(item, str) and item in known}
        named = named - held or named  # lists that all name every frame mean it
    chosen = sorted(named & set(indices))
    if not chosen:
        raise UserError(f"{path}: no frame of {name}_filenames is left; choose more frames, or restore their images")
    return chosen


class _Names:
    """Numbers of frames by their names, which lists may write in other ways: ``./a.png`` for ``a.png``, another slash,
    or the file's name alone."""

    def __init__(self, names: list[str]) -> None:
        self._numbers: dict[str, int] = {}
        short: dict[str, list[int]] = {}
        for index, name in enumerate(names):
            self._numbers.setdefault(name, index)
            self._numbers.setdefault(_plain(name), index)
            short.setdefault(_plain(name).rsplit("/", 1)[-1], []).append(index)
        for name, indices in short.items():
            if len(indices) == 1:
                self._numbers.setdefault(name, indices[0])

    def __contains__(self, name: str) -> bool:
        return name in self._numbers or _plain(name) in self._numbers

    def __getitem__(self, name: str) -> int:
        return self._numbers[name if name in self._numbers else _plain(name)]


def _plain(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).as_posix()


def _points(
    path: Path, folder: Path, content: dict[str, Any], cameras: list[Camera], offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None] | None:
    """Read points [P, 3] in the frame of the poses, less ``offset``, and their colours [P, 3]; None without a file."""
    name = content.get("ply_file_path")
    if name is None or name == "":
        return None
    if not isinstance(name, str):
        raise UserError(f"{path}: ply_file_path is not text; name the file of points or leave it out")
    points, colors = read_points(inside(folder, name, f"{path}: ply_file_path"))
    applied = _applied(path, content, points)
    points = points - offset
    # Some writers apply the poses' transform to the points and some do not: keep the version that more cameras see.
    if applied is not None and _seen(applied - offset, cameras) > _seen(points, cameras):
        points = applied - offset
    return points, colors


def _applied(path: Path, content: dict[str, Any], points: np.ndarray) -> np.ndarray | None:
    """Apply ``applied_transform`` and ``applied_scale`` to the points; return None if the file has neither of them."""
    if "applied_transform" not in content and "applied_scale" not in content:
        return None
    matrix = as_array(content.get("applied_transform", np.eye(4).tolist()), (3, 4), (4, 4))
    scale = as_number(content.get("applied_scale", 1.0))
    if matrix is None or scale is None or scale <= 0.0:
        raise UserError(
            f"{path}: applied_transform must be 3 or 4 rows of 4 numbers, and applied_scale a positive number; "
            "correct them or leave them out"
        )
    return (points @ matrix[:3, :3].T + matrix[:3, 3]) * scale


def _seen(points: np.ndarray, cameras: list[Camera]) -> int:
    """Count the pairs of a point and a camera in which the point projects into the image."""
    total = 0
    for camera in cameras:
        viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
        local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        ahead = local[local[:, 2] > 1e-9]
        pixels = ahead @ K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        total += int(((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1).sum())
    return total
