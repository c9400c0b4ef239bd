"""What DyCheck's iPhone data add to the layout of Nerfies: splits, depth by LiDAR, and masks of what is covisible.

``splits/train.json`` and ``val.json``: ``frame_names``, ``time_ids``, ``camera_ids``; ``depth/1x/ID.npy``, [h, w, 1]
along the camera's z, 0 where unknown; ``covisible/2x/val/ID.png``, white where enough training images show the same;
``extra.json``. Training frames are of camera 0, which moves; held-out ones of cameras that stand still.
Layout: Gao et al., Monocular Dynamic View Synthesis: A Reality Check, NeurIPS 2022.

The documentation of these data calls depth millimetres, but the program that writes them writes metres, as those that
read them take it; so does this reader. Depth is cut at a distance chosen for each scene (3 m), beyond which a map shows
this distance: as in DyCheck's own loss, that counts as depth. Alpha marks the pixels for which the phone gave a depth,
and thus a colour; the others are no part of the loss there, and are masked here.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from ...errors import UserError
from ...storage.json_files import as_number, read_json
from ..dataset import Dataset
from ..depth_points import points_of_depth

TRAIN, VAL, EXTRA = "splits/train.json", "splits/val.json", "extra.json"
COVISIBLE = ("covisible", "flow3d_preprocessed/covisible")
"""Folders of masks: those of DyCheck, and those of Shape of Motion, for images of full size."""
MOST_BEYOND = 50.0
"""How many times farther than ``far`` in ``scene.json`` the median of a depth map may be."""


class Splits(NamedTuple):
    """Content of ``splits``, in the order of the files."""

    train: list[str]
    val: list[str]
    times: dict[str, float]
    """Time of each frame, in frames of the film; empty if the files do not tell."""
    cameras: dict[str, str]
    """Camera of each frame; empty if the files do not tell."""


def recognises(folder: Path) -> bool:
    """Return whether a folder in the layout of Nerfies is one of DyCheck."""
    return any((folder / name).is_file() for name in (TRAIN, EXTRA))


def read_splits(folder: Path) -> Splits | None:
    """Read the lists of frames; None without them.

    Raises:
        UserError: a list is missing, or the lists of a file differ in length.
    """
    if not (folder / TRAIN).is_file():
        return None
    splits = Splits([], [], {}, {})
    for name, names in ((TRAIN, splits.train), (VAL, splits.val)):
        path = folder / name
        if name == VAL and not path.is_file():
            continue
        content = read_json(path)
        listed = content.get("frame_names")
        if not isinstance(listed, list) or (name == TRAIN and not listed):
            raise UserError(f"{path}: frame_names is missing, empty or not a list; name the frames there")
        names.extend(str(item) for item in listed)
        if content.get("time_ids") is not None:
            splits.times.update(zip(names, _ids(path, "time_ids", content["time_ids"], len(names))))
        if content.get("camera_ids") is not None:
            cameras = _ids(path, "camera_ids", content["camera_ids"], len(names))
            splits.cameras.update(zip(names, (f"{camera:g}" for camera in cameras)))
    every = {*splits.train, *splits.val}
    return splits._replace(
        times=splits.times if set(splits.times) == every else {},
        cameras=splits.cameras if set(splits.cameras) == every else {},
    )


def _ids(path: Path, key: str, values: Any, count: int) -> list[float]:
    numbers = [as_number(value) for value in values] if isinstance(values, list) else []
    known = [number for number in numbers if number is not None]
    if len(known) != count or len(numbers) != count:
        raise UserError(f"{path}: {key} is no list of {count} numbers, one for each of frame_names; correct the lists")
    return known


def scaled_file(folder: Path, ratio: int, name: str) -> Path | None:
    """Return ``RATIOx/name`` in a folder, or else the one of another size, the largest first; None without any."""
    sizes = [int(match[1]) for each in _entries(folder) if (match := re.fullmatch(r"([1-9][0-9]{0,2})x", each.name))]
    files = (folder / f"{size}x" / name for size in sorted(sizes, key=lambda size: (size != ratio, size)))
    return next((file for file in files if file.is_file()), None)


def _entries(folder: Path) -> list[Path]:
    return [each for each in folder.iterdir() if each.is_dir()] if folder.is_dir() else []


def covisible_mask(folder: Path, ratio: int, name: str) -> Path | None:
    """Return the mask of a held-out frame; None without one."""
    found = (scaled_file(folder / place, ratio, f"val/{name}.png") for place in COVISIBLE)
    return next((file for file in found if file is not None), None)


def notes_of_maps(folder: Path, split: str, depths: Sequence[Any], masks: Sequence[Any]) -> tuple[str, ...]:
    """Return notes on depth maps and masks that are missing where other frames of the split have them."""
    notes = []
    for kind, files, due in (("depth", depths, split == "train"), ("covisible", masks, split != "train")):
        missing = sum(file is None for file in files)
        if due and 0 < missing < len(files):
            what = "depth map; they count as frames without one" if kind == "depth" else "mask; mpsnr leaves them out"
            notes.append(f"{folder / kind}: {missing} of {len(files)} {split} frames have no {what}")
    return tuple(notes)


def lidar_points(folder: Path, data: Dataset) -> tuple[np.ndarray, np.ndarray] | None:
    """Return points [P, 3] of the surfaces that depth maps show, world units, and their colours [P, 3] in [0, 1]; None
    without depth.

    Raises:
        UserError: a map is damaged, does not fit its image, or has another unit than the cameras.
    """

    def check(name: str, known: Tensor) -> None:
        if data.bounds is not None and float(known.median()) > MOST_BEYOND * data.bounds[1]:
            raise UserError(
                f"{folder / 'depth'}: {name} is {float(known.median()) / data.bounds[1]:.0f} times as far away "
                "as far in scene.json says; give depth in the units of the cameras (metres, not millimetres)"
            )

    return points_of_depth(data, check)
