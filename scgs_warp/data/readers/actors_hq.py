"""Reader of ActorsHQ: ``calibration.csv``, and ``rgbs/Cam001/Cam001_rgb000000.jpg`` for each camera and instant.

A row of the table holds ``name, w, h``; ``rx, ry, rz``, the camera-to-world rotation as an axis times an angle in
radians; ``tx, ty, tz``, the camera's position in metres; ``fx, fy, px, py``, focal lengths and principal point as
shares of width and height. Cameras are OpenCV's. ``masks/Cam001/Cam001_mask000000.png`` cuts out the actor; without
masks, the studio is seen.
Layout: Işık et al., HumanRF, SIGGRAPH 2023.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...errors import UserError
from ...storage.files import read_text
from ..dataset import Dataset
from ..images import ReadOptions
from ..lens import Lens
from .rig import RigCamera, fitted_lens, images_in, read_rig

FILE = "calibration.csv"
NUMBERS = ("w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")
MAX_TEXT_BYTES = 1 << 22
MAX_NUMBER = 1e9
HELD_OUT = (1, 14, 25, 31, 44, 58, 64, 65, 71, 85, 98, 104, 115, 127)
"""Numbers of the cameras that HumanRF tests on."""


def recognises(folder: Path) -> bool:
    """Return whether the folder holds this layout."""
    return (folder / FILE).is_file() and (folder / "rgbs").is_dir()


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split: the cameras that HumanRF tests on are ``test`` and ``val``, or the first one if none of them is
    there. Times are those in the names of images. The actor is cut out if every image of the split has a mask.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    path = folder / FILE
    cameras = []
    for name, row in _rows(path).items():
        where = f"{path}: {name}"
        rotation = Rotation.from_rotvec([row["rx"], row["ry"], row["rz"]]).as_matrix()
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation.T, -rotation.T @ [row["tx"], row["ty"], row["tz"]]
        size = int(row["w"]), int(row["h"])
        if min(size) < 1 or size != (row["w"], row["h"]) or min(row["fx"], row["fy"]) <= 0.0:
            raise UserError(f"{where} has a size or focal length that is not positive; restore the file")
        lens = Lens(row["fx"] * size[0], row["fy"] * size[1], row["px"] * size[0], row["py"] * size[1])
        files = {stem.removeprefix(f"{name}_"): file for stem, file in images_in(folder / "rgbs" / name).items()}
        masks = {stem.removeprefix(f"{name}_mask"): file for stem, file in images_in(folder / "masks" / name).items()}
        cut = {instant: masks[instant.removeprefix("rgb")] for instant in files if instant.removeprefix("rgb") in masks}
        cameras.append(RigCamera(name, viewmat, partial(fitted_lens, where, lens, size), files, cut))
    return read_rig(path, folder, cameras, split, options, held=[f"Cam{number:03d}" for number in HELD_OUT])


def _rows(path: Path) -> dict[str, dict[str, float]]:
    """Read the table: the numbers of each camera by its name.

    Raises:
        UserError: the file is no such table.
    """
    try:
        lines = [line.split(",") for line in read_text(path, MAX_TEXT_BYTES).splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError):
        raise UserError(f"{path}: cannot be read as text; restore the file") from None
    header = [word.strip() for word in lines[0]] if lines else []
    missing = [name for name in ("name", *NUMBERS) if name not in header]
    if missing:
        raise UserError(f"{path}: has no column {missing[0]}; restore the file")
    rows = {}
    for number, words in enumerate(lines[1:], 2):
        fields = dict(zip(header, (word.strip() for word in words)))
        name = fields.get("name", "")
        try:
            values = {key: float(fields[key]) for key in NUMBERS}
        except (KeyError, ValueError):
            raise UserError(f"{path}: row {number} is not a name and numbers; restore the file") from None
        if not all(abs(value) < MAX_NUMBER for value in values.values()):
            raise UserError(f"{path}: row {number} holds NaN, infinity or absurd numbers; restore the file")
        if not name or name != Path(name).name or name in rows or "\\" in name or name == "..":
            raise UserError(f"{path}: row {number} has no name of its own, or one of a folder elsewhere; restore it")
        rows[name] = values
    return rows
