"""Reader of the Nerfies layout, shared by HyperNeRF and NeRF-DS: one JSON file per camera, images at several scales.

``dataset.json``: ``ids``, ``train_ids``, ``val_ids``; ``metadata.json``: for each id ``time_id``, or ``warp_id`` in
older data; ``camera/ID.json``: ``orientation`` (world-to-camera, OpenCV), ``position``, ``focal_length``,
``principal_point``, ``skew``, ``pixel_aspect_ratio``, ``radial_distortion``, ``tangential_distortion``,
``image_size``; ``scene.json``: ``center`` and ``scale`` of the world, and ``near`` and ``far`` in it; ``points.npy``;
``rgb/1x/ID.png``, ``rgb/2x`` ...
Layout: Park et al., Nerfies, ICCV 2021; HyperNeRF, SIGGRAPH Asia 2021; Yan et al., NeRF-DS, CVPR 2023.

The masks of NeRF-DS mark moving pixels, not invalid ones, and are ignored. DyCheck's iPhone data (:mod:`dycheck`) have
splits, depth and masks of what is covisible, too.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import UserError
from ...geometry.rotation import is_rotation
from ...storage.json_files import as_array, as_number, read_json
from ...storage.numpy_files import read_npy
from ...storage.safe_paths import first_there
from ..assemble import FrameRecord, assemble, with_points
from ..choice import choose
from ..dataset import Dataset
from ..depth_maps import DepthFile
from ..held_out import held_out
from ..images import ReadOptions, size_text
from ..lens import Lens, make_lens
from . import dycheck
from .transforms import IMAGE_SUFFIXES

FILE = "dataset.json"


class World(NamedTuple):
    """World transform of ``scene.json``: scaled = (file - centre) * scale."""

    centre: np.ndarray
    scale: float
    bounds: tuple[float, float] | None = None
    """Nearest and farthest depth of the content, scaled; None if the file does not tell."""


class Listing(NamedTuple):
    """Frames that a data set lists."""

    path: Path
    """File that lists them, named in messages."""
    names: list[str]
    train: list[str]
    """Those to train on; empty: all that are not held out."""
    held: list[str]
    times: list[float]
    """Of ``names``, in [0, 1]."""
    cameras: list[str]
    """Of ``names``; empty names if the data set has none."""


def recognises(folder: Path) -> bool:
    """Return whether the folder holds this layout."""
    return any((folder / name).is_file() for name in (FILE, dycheck.TRAIN)) and (folder / "camera").is_dir()


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split: the ids listed in ``dataset.json`` or, for DyCheck, in ``splits``, each with its camera and
    image.

    ``test`` and ``val`` are ``val_ids``, which are never trained on; if that list is empty, every eighth id is held
    out. Times are ``time_id`` or ``warp_id``, scaled to [0, 1] over all listed frames. The camera of a frame is
    ``camera_id``.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    listing = _listing(folder)
    world = _world(folder / "scene.json")
    images, ratio = _images(folder / "rgb", options.downscale)
    files = [_image(images, name) for name in listing.names]
    choice = choose(listing.path, files, listing.times, options, listing.cameras)
    chosen = {listing.names[index]: index for index in choice.indices}
    by_lidar = dycheck.recognises(folder)
    records = []
    for name in _of_split(listing, list(chosen), split, bool(options.only_cameras)):
        path = folder / "camera" / f"{name}.json"
        content = read_json(
            path, f"each listed id needs its camera; restore it or drop the id from {listing.path.name}"
        )
        depth = dycheck.scaled_file(folder / "depth", ratio, f"{name}.npy") if by_lidar else None
        records.append(
            FrameRecord(
                files[chosen[name]],
                _viewmat(path, content, world),
                choice.times[chosen[name]],
                partial(_lens, path, content, ratio),
                name,
                depth=None if depth is None else DepthFile(depth, world.scale),
                masked_by_alpha=by_lidar,
                covisible=None if split == "train" else dycheck.covisible_mask(folder, ratio, name),
            )
        )
    reduced = options._replace(downscale=max(1.0, options.downscale / ratio))
    notes = dycheck.notes_of_maps(folder, split, [r.depth for r in records], [r.covisible for r in records])
    data = assemble(records, reduced, folder=folder, split=split, notes=(*choice.notes, *notes))
    data.bounds = world.bounds
    points = dycheck.lidar_points(folder, data)
    return with_points(data, *(points or (_points(folder / "points.npy", world), None)))


def _listing(folder: Path) -> Listing:
    """Read which frames there are, and their times and cameras."""
    splits = dycheck.read_splits(folder)
    if splits is None:
        path, lists, times, cameras = folder / FILE, _lists(folder / FILE), {}, {}
    else:
        path, times, cameras = folder / dycheck.TRAIN, splits.times, splits.cameras
        lists = {"ids": [], "train_ids": splits.train, "val_ids": splits.val}
        _check_names(path, "frame_names", [*splits.train, *splits.val])
    names = list(dict.fromkeys(name for each in lists.values() for name in each))
    if times and cameras:
        return Listing(
            path,
            names,
            lists["train_ids"],
            lists["val_ids"],
            _scaled([times[name] for name in names]),
            [cameras[name] for name in names],
        )
    return Listing(path, names, lists["train_ids"], lists["val_ids"], *_times(folder / "metadata.json", names))


def _check_names(path: Path, key: str, names: list[str]) -> None:
    """Refuse names that are none of files."""
    for item in names:
        if not re.fullmatch(r"[\w.+=@, -]{1,200}", item) or item.strip() != item or item[0] == ".":
            raise UserError(f"{path}: {key} holds {item[:40]!r}, which names no file; correct the id")


def _lists(path: Path) -> dict[str, list[str]]:
    """Read the lists ``ids``, ``train_ids`` and ``val_ids``; at least one of them is not empty."""
    content = read_json(path)
    lists: dict[str, list[str]] = {}
    for key in ("ids", "train_ids", "val_ids"):
        values = content.get(key, [])
        if not isinstance(values, list) or not all(isinstance(item, (str, int)) for item in values):
            raise UserError(f"{path}: {key} is not a list of names; list the frames there")
        lists[key] = list(dict.fromkeys(str(item) for item in values))
        _check_names(path, key, lists[key])
    if not any(lists.values()):
        raise UserError(f"{path}: ids, train_ids and val_ids are missing or empty; list the frames there")
    return lists


def _of_split(listing: Listing, chosen: list[str], split: str, chosen_cameras: bool) -> list[str]:
    """Return those of the ``chosen`` ids that belong to this split."""
    known = set(chosen)
    held = [item for item in listing.held if item in known]
    pool = [item for item in listing.train if item in known] or chosen
    outside = set(held)
    rest = [item for item in pool if item not in outside]
    if not held or (not rest and chosen_cameras):  # of one camera of a rig, all frames may be held out
        return [pool[index] for index in held_out(listing.path, range(len(pool)), split)]
    if split != "train":
        return held
    if not rest:
        raise UserError(
            f"{listing.path}: train_ids are all among val_ids, nothing is left to train on; correct the lists"
        )
    return rest


def _image(folder: Path, name: str) -> Path:
    """Return the image of an id."""
    candidates = [folder / f"{name}{suffix}" for suffix in IMAGE_SUFFIXES]
    return first_there(candidates) or candidates[0]


def _times(path: Path, names: list[str]) -> tuple[list[float], list[str]]:
    """Return times in [0, 1] and the names of the cameras from the metadata of all frames; without metadata, times are
    evenly spaced in the listed order, and the cameras have no names."""
    if not path.is_file():
        return [index / max(len(names) - 1, 1) for index in range(len(names))], [""] * len(names)
    content = read_json(path)
    values, cameras, keys = [], [], set()
    for name in names:
        entry = content.get(name)
        key = "time_id" if isinstance(entry, dict) and "time_id" in entry else "warp_id"
        value = as_number(entry.get(key)) if isinstance(entry, dict) else None
        if value is None:
            raise UserError(f"{path}: {name}.{key} is missing or not a number; give each frame its instant")
        values.append(value)
        keys.add(key)
        camera = as_number(entry.get("camera_id")) if isinstance(entry, dict) else None
        cameras.append("" if camera is None else f"{camera:g}")
    if keys == {"warp_id"} and len(set(cameras)) == 1:
        values = _counted(names, values)
    return _scaled(values), cameras


def _counted(names: list[str], values: list[float]) -> list[float]:
    """Return the numbers at the ends of the names of one camera's frames instead of their ``values``, if some values
    repeat: the notebook of Nerfies gives a held-out frame the ``warp_id`` of the training frame that follows. Names
    without numbers, or of another order, do not count."""
    found = [re.search("[0-9]{1,9}$", name) for name in names]
    numbers = [int(match[0]) for match in found if match is not None]
    if len(set(values)) == len(values) or len(set(numbers)) < len(names):
        return values
    ordered = [value for _, value in sorted(zip(numbers, values))]
    return [float(number) for number in numbers] if ordered == sorted(values) else values


def _scaled(values: list[float]) -> list[float]:
    """Scale times to go from 0 to 1."""
    first, last = min(values), max(values)
    return [(value - first) / (last - first) if last > first else 0.0 for value in values]


def _world(path: Path) -> World:
    if not path.is_file():
        return World(np.zeros(3), 1.0)
    content = read_json(path)
    centre, scale = as_array(content.get("center"), (3,)), as_number(content.get("scale"))
    if centre is None:
        raise UserError(f"{path}: center is missing or not three numbers; restore it, or remove the file")
    if scale is None or scale <= 0:
        raise UserError(f"{path}: scale is missing or not a positive number; restore it, or remove the file")
    near, far = as_number(content.get("near")), as_number(content.get("far"))
    bounds = None if near is None or far is None or not 0.0 < near < far else (near, far)
    return World(centre, scale, bounds)


def _images(folder: Path, downscale: float) -> tuple[Path, int]:
    """Choose the folder of the smallest images that are large enough, or else of the largest images. Return the folder,
    and the ratio of the cameras' image size to the size of its images."""
    folders = {}
    for inner in folder.iterdir() if folder.is_dir() else ():
        match = re.fullmatch(r"([1-9][0-9]{0,2})x", inner.name)
        if match and inner.is_dir():
            folders[int(match[1])] = inner
    if not folders:
        raise UserError(f"{folder}: no folder of images, 1x, 2x, 4x ...; put the full-size images into {folder}/1x")
    ratio = max([ratio for ratio in folders if ratio <= downscale], default=min(folders))
    return folders[ratio], ratio


def _viewmat(path: Path, content: dict[str, Any], world: World) -> np.ndarray:
    rotation, position = as_array(content.get("orientation"), (3, 3)), as_array(content.get("position"), (3,))
    if rotation is None or not is_rotation(rotation):
        raise UserError(f"{path}: orientation is not a rotation of 3 x 3 numbers; correct it or drop the id")
    if position is None:
        raise UserError(f"{path}: position is not three finite numbers; correct it or drop the id")
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ ((position - world.centre) * world.scale)
    return viewmat


def _lens(path: Path, content: dict[str, Any], ratio: int, source: tuple[int, int]) -> Lens:
    """Return the lens at the size of the images, which is the camera's image size divided by ``ratio``. A camera that
    states no size has that of the images."""
    size = as_array(content.get("image_size", [ratio * side for side in source]), (2,))
    if size is None or (size < 1).any():
        raise UserError(f"{path}: image_size is not two positive numbers; give width and height in pixels")
    if (np.abs(size / ratio - source) > 1.0).any():
        raise UserError(
            f"{path}: image_size is {size[0]:g} x {size[1]:g}, but the images in rgb/{ratio}x are {size_text(source)}; "
            "they must be that many times smaller; correct the camera or resize the images"
        )
    focal, centre = as_number(content.get("focal_length")), as_array(content.get("principal_point"), (2,))
    aspect, skew = as_number(content.get("pixel_aspect_ratio", 1.0)), as_number(content.get("skew", 0.0))
    if focal is None or focal <= 0 or aspect is None or aspect <= 0:
        raise UserError(f"{path}: focal_length or pixel_aspect_ratio is missing or not a positive number; give pixels")
    if centre is None or skew is None:
        raise UserError(f"{path}: principal_point or skew is missing or not a number; give pixels")
    radial = as_array(content.get("radial_distortion") or [0.0] * 3, (2,), (3,), (4,))
    tangential = as_array(content.get("tangential_distortion") or content.get("tangential") or [0.0] * 2, (2,))
    if radial is None or tangential is None or (len(radial) == 4 and radial[3] != 0):
        raise UserError(
            f"{path}: radial_distortion must be three numbers, tangential_distortion two; correct them, or undistort "
            "the images and leave them out"
        )
    k1, k2, k3 = (*radial, 0.0)[:3]
    sx, sy = source / size
    fx, fy, cx, cy = focal * sx, focal * aspect * sy, centre[0] * sx, centre[1] * sy
    params = tuple(map(float, (fx, fy, cx, cy, k1, k2, *tangential, k3, 0.0, 0.0, 0.0)))
    try:
        return make_lens("FULL_OPENCV", params, skew * sx)
    except ValueError as error:
        raise UserError(f"{path}: {error}; correct the camera or drop the id") from None


def _points(path: Path, world: World) -> np.ndarray | None:
    if not path.is_file():
        return None
    points = read_npy(path)
    if points.ndim != 2 or points.shape[1] != 3:
        raise UserError(f"{path}: has shape {list(points.shape)}; give [P, 3] positions, or remove the file")
    return (points - world.centre) * world.scale
