"""Reader of the Neural 3D Video layout: LLFF's ``poses_bounds.npy`` for a rig of cameras, and a folder of images each.

``poses_bounds.npy [C, 17]``: rows of 3 x 5, the camera-to-world rotation in columns (down, right, backwards),
position, and (height, width, focal length) in pixels; nearest and farthest depth. Row c belongs to the c-th camera in
the order of names: ``cam00/images/0000.png``, ``cam00/0000.png`` or ``frames/cam00/0000.png``. For a film of one camera
that moves, row c belongs to the c-th image in ``images``; films of operations have more (``surgical``). Layouts:
Mildenhall et al., LLFF, 2019; Li et al., Neural Scene Flow Fields, CVPR 2021; Li et al., Neural 3D Video Synthesis,
CVPR 2022.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import UserError
from ...geometry.rotation import is_rotation
from ...storage.numpy_files import read_npy
from ..assemble import FrameRecord, assemble, with_points
from ..choice import choose, held_camera, of_cameras
from ..dataset import Dataset
from ..depth_maps import DepthFile
from ..depth_points import points_of_depth
from ..held_out import held_out
from ..images import ReadOptions, size_text
from ..lens import Lens
from ..natural_order import by_name, natural
from ..points import read_points
from .colmap_images import reduced_folders
from .colmap_model import find_model
from .surgical import as_llff, find_surgical, notes_of_masks
from .transforms import IMAGE_SUFFIXES

FILE = "poses_bounds.npy"
VIDEOS = (".mp4", ".mov", ".avi", ".mkv")
MANY = "mv_images"
"""Folder of the images of all cameras of an instant, beside the film that takes one of them."""
POINTS = ("points3D.ply", "points3D_downsample2.ply", "points3d.ply")
MAX_ASPECT_ERROR = 0.01
"""Largest relative difference between the scale factors of width and height that is attributed to rounding."""


def recognises(folder: Path) -> bool:
    """Return whether the folder holds this layout, and not the COLMAP model of one camera's images, beside which LLFF
    and others keep this file."""
    if not (folder / FILE).is_file():
        return False
    single = [path for path in (folder / "images", *reduced_folders(folder)) if path.is_dir()]
    alone = any(file.suffix.lower() in IMAGE_SUFFIXES for path in single for file in path.iterdir() if file.is_file())
    return not (alone and find_model(folder) is not None)


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split: the camera that is chosen first is ``test`` and ``val`` (of all, the first: the central one of
    Neural 3D Video, as in published results), the others are ``train``. Of the film of one camera, the views of the
    other cameras are held out or, without these, every eighth image.

    All cameras share the same times, which are evenly spaced in the order of the images' names.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    path = folder / FILE
    rows = read_rows(path)
    film = _film(folder, len(rows))
    if film:
        return _read_film(folder, film, rows, split, options)
    cameras, notes = _of_rig(folder, _cameras(folder), len(rows))
    if len(cameras) != len(rows):
        raise UserError(
            f"{path}: has {len(rows)} rows, but {folder} holds {len(cameras)} folders of images "
            f"({_label(folder, cameras[0])} to {_label(folder, cameras[-1])}); give each camera a row and a folder"
        )
    labels = [_label(folder, camera) for camera in cameras]
    wanted = of_cameras(labels, options)
    if len(wanted) < 2:
        raise UserError(f"--only-cameras {options.only_cameras}: name two cameras or more; the first is held out")
    kept_out = labels.index(held_camera(labels, options))
    chosen = [index for index in wanted if (index == kept_out) != (split == "train")]
    files = _with_gaps([_files(camera) for camera in cameras])
    records = []
    for index in chosen:
        if len(files[index]) != len(files[kept_out]):
            raise UserError(
                f"{cameras[index]}: holds {len(files[index])} images, but {_label(folder, cameras[kept_out])} "
                f"{len(files[kept_out])}; all cameras need the same instants"
            )
        viewmat = row_viewmat(path, index, rows[index, :15].reshape(3, 5))
        lens = partial(row_lens, path, index, rows[index, :15].reshape(3, 5)[:, 4])
        last = max(len(files[index]) - 1, 1)
        for instant, file in enumerate(files[index]):
            records.append(
                FrameRecord(file, viewmat, instant / last, lens, f"{_label(folder, cameras[index])}_{file.stem}")
            )
    choice = choose(path, [r.file for r in records], [r.time for r in records], options)
    frames = [replace(records[index], time=choice.times[index]) for index in choice.indices]
    data = assemble(frames, options, folder=folder, split=split, notes=(*notes, *choice.notes))
    data.bounds = _bounds(rows[wanted, 15:])
    points = next((folder / name for name in POINTS if (folder / name).is_file()), None)
    return data if points is None else with_points(data, *read_points(points))


def _film(folder: Path, count: int) -> list[Path]:
    """Return the images of one camera that moves, in the order of the rows; none if there is not one for each row."""
    files = sorted(_files(folder / "images"), key=lambda p: p.name) if (folder / "images").is_dir() else []
    return files if len(files) == count else []


def _read_film(folder: Path, files: list[Path], rows: np.ndarray, split: str, options: ReadOptions) -> Dataset:
    """Read a film of one camera: the views of the other cameras are held out or, without these, every eighth image.
    Times are evenly spaced in the order of names."""
    surgical = find_surgical(folder, len(files))
    rows = rows if surgical is None else as_llff(rows)
    path, ranks = folder / FILE, {index: rank for rank, index in enumerate(by_name(files))}
    times = [ranks[index] / (len(files) - 1) for index in range(len(files))]
    choice = choose(path, files, times, options, ["images"] * len(files))
    order = sorted(choice.indices, key=lambda index: times[index])

    def record(file: Path, camera: int, index: int, name: str) -> FrameRecord:
        pose = rows[camera, :15].reshape(3, 5)
        lens = partial(row_lens, path, camera, pose[:, 4])
        found = FrameRecord(file, row_viewmat(path, camera, pose), choice.times[index], lens, name)
        if surgical is None:
            return found
        depth = DepthFile(surgical.depth[index], 1.0, whole=True)
        return replace(found, mask=surgical.masks[index], mask_excludes=True, depth=depth)

    views = _other_views(folder, len(files))
    if views and split != "train":
        of_instants = [view for view in views if view.index in choice.indices]
        records = [record(view.file, view.camera, view.index, view.name) for view in of_instants]
    else:
        chosen = choice.indices if views else held_out(path, order, split)
        records = [record(files[index], index, index, files[index].stem) for index in chosen]
    data = assemble(records, options, folder=folder, split=split, notes=choice.notes)
    data.bounds = _bounds(rows[choice.indices, 15:])
    if surgical is None or split != "train":
        return data
    data.notes = (*data.notes, *notes_of_masks(folder, data))
    points = points_of_depth(data)
    return data if points is None else with_points(data, *points)


class _View(NamedTuple):
    """An image of the instant of image ``index`` by a camera that filmed another one."""

    file: Path
    camera: int
    """Row of the camera."""
    index: int
    name: str


def _other_views(folder: Path, count: int) -> list[_View]:
    """Return the images of the data of Yoon et al. by which Neural Scene Flow Fields is scored: of twelve cameras that
    stand, which the film takes in turn, those that it does not take at an instant; none if ``mv_images`` does not hold
    them all."""
    shown = {file.stem: file for file in _files(folder / MANY / "00000")} if (folder / MANY / "00000").is_dir() else {}
    names = [f"cam{camera + 1:02d}" for camera in range(len(shown))]
    if not 2 <= len(shown) <= count or set(shown) != set(names):
        return []
    views = [
        _View(folder / MANY / f"{index:05d}" / shown[name].name, camera, index, f"{index:05d}_{name}")
        for index in range(count)
        for camera, name in enumerate(names)
        if index % len(names) != camera
    ]
    return views if all(view.file.is_file() for view in views) else []


def _bounds(depths: np.ndarray) -> tuple[float, float] | None:
    """Return the nearest and the farthest of the cameras' depths [C, 2]; None if they are no depths."""
    near, far = float(depths[:, 0].min()), float(depths[:, 1].max())
    return (near, far) if 0.0 < near < far < np.inf else None


def read_rows(path: Path) -> np.ndarray:
    """Read the rows [C, 17] of ``poses_bounds.npy``.

    Raises:
        UserError: the file is missing, damaged or has another shape.
    """
    rows = read_npy(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) < 2:
        raise UserError(
            f"{path}: has shape {list(rows.shape)}; give [C, 17] with one row for each of two or more cameras"
        )
    return rows


def _label(folder: Path, camera: Path) -> str:
    """Return the name of a camera's folder, or of its parent if the folder is called ``images``."""
    own = camera.parent if camera.name == "images" and camera.parent != folder else camera
    return own.name


def _cameras(folder: Path) -> list[Path]:
    """Return the cameras' folders of images, in the order of their names."""
    base = folder / "frames" if (folder / "frames").is_dir() else folder
    cameras = []
    for camera in sorted((p for p in base.iterdir() if p.is_dir() and _is_shown(p)), key=lambda p: natural(p.name)):
        inner = camera / "images" if (camera / "images").is_dir() else camera
        if _files(inner):
            cameras.append(inner)
    if cameras:
        return cameras
    videos = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in VIDEOS)
    if videos:
        raise UserError(
            f"{folder / videos[0]}: a video, not images; unpack all of them: python apps/capture.py --rig {folder} "
            f"--output {folder}-images"
        )
    raise UserError(f"{base}: no folder of images for any camera; put them into cam00/images, cam01/images, ...")


def _of_rig(folder: Path, cameras: list[Path], count: int) -> tuple[list[Path], tuple[str, ...]]:
    """Return the ``count`` folders whose names differ only in their numbers, if there are more folders, and a note on
    the others: programs put images for COLMAP, or masks, beside the cameras."""
    alike: dict[str, list[Path]] = {}
    for camera in cameras:
        alike.setdefault(re.sub("[0-9]+", "0", _label(folder, camera)), []).append(camera)
    fitting = [group for group in alike.values() if len(group) == count]
    if len(cameras) <= count or len(fitting) != 1:
        return cameras, ()
    others = ", ".join(_label(folder, camera) for camera in cameras if camera not in fitting[0])
    return fitting[0], (f"{folder}: of more folders than {FILE} has rows, these are left out: {others[:80]}",)


def _is_shown(path: Path) -> bool:
    """Return whether a file or folder is none that systems hide, such as ``._0000.png`` of macOS."""
    return not path.name.startswith(".")


def _files(folder: Path) -> list[Path]:
    files = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and _is_shown(p)]
    return sorted(files, key=lambda p: natural(p.name))


def _with_gaps(files: list[list[Path]]) -> list[list[Path]]:
    """Return the cameras' images of all instants. If few cameras have fewer images than most, under the same names,
    their lists also name the images that are missing."""
    longest = max(files, key=len)
    names = [file.stem for file in longest]
    complete = sum(len(own) == len(longest) for own in files)
    if 2 * complete <= len(files) or not {file.stem for own in files for file in own} <= set(names):
        return files
    there = [{file.stem: file for file in own} for own in files]
    return [[own.get(p.stem, each[0].with_name(p.name)) for p in longest] for own, each in zip(there, files)]


def row_viewmat(path: Path, index: int, pose: np.ndarray) -> np.ndarray:
    """Return the world-to-camera matrix [4, 4], OpenCV, of a row of the file."""
    down, right, backwards, position = pose[:, 0], pose[:, 1], pose[:, 2], pose[:, 3]
    rotation = np.stack([right, down, -backwards])
    if not np.isfinite(pose).all() or not is_rotation(rotation):
        raise UserError(f"{path}: row {index} holds a matrix that is not a finite rotation; restore the file")
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    return viewmat


def row_lens(path: Path, index: int, column: np.ndarray, source: tuple[int, int]) -> Lens:
    """Return the lens of images, which may be smaller than the images of the calibration."""
    height, width, focal = column
    if min(height, width, focal) < 1:
        raise UserError(f"{path}: row {index} has a non-positive height, width or focal length; restore the file")
    sx, sy = source[0] / width, source[1] / height
    if abs(sx / sy - 1.0) > MAX_ASPECT_ERROR:
        raise UserError(
            f"{path}: row {index} is of {width:g} x {height:g} pixels, but the images are {size_text(source)}; "
            "reduce width and height alike"
        )
    return Lens(focal * sx, focal * sy, 0.5 * source[0], 0.5 * source[1])
