"""Reader of EasyMocap's layout (ENeRF-Outdoor, Mobile-Stage, DNA-Rendering, NHR, SelfCap and others for 4K4D).

``intri.yml`` and ``extri.yml``, in the folder or in ``optimized/``, as OpenCV writes YAML; ``images/00/000000.jpg``, or
``00/000000.jpg``, for each camera and instant. ``names``, a list; per camera ``K_NAME [3, 3]``, pixels, ``dist_NAME``
or ``D_NAME``, OpenCV's ``k1, k2, p1, p2, k3``, and ``H_NAME, W_NAME``, which may be missing; ``Rot_NAME [3, 3]`` or
``R_NAME [3, 1]``, an axis times an angle in radians, and ``T_NAME [3, 1]``, world-to-camera. ``masks/`` is ignored.
Cameras are OpenCV's. Layouts: EasyMocap's repository; Xu et al., 4K4D, CVPR 2024.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...errors import UserError
from ...geometry.rotation import is_rotation
from ...storage.files import read_text
from ..dataset import Dataset
from ..images import ReadOptions
from ..lens import Lens, make_lens
from .rig import RigCamera, fitted_lens, images_in, read_rig

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"
MAX_TEXT_BYTES = 1 << 24
MAX_NUMBER = 1e9
KEY = re.compile(r"([A-Za-z_][^\s:]{0,200}):(.*)")
LARGEST_SIDE = 1e6


def recognises(folder: Path) -> bool:
    """Return whether the folder holds this layout."""
    return _cameras_in(folder) is not None


def _cameras_in(folder: Path) -> Path | None:
    """Return the folder of the cameras: the optimised ones if there are any."""
    places = (folder / "optimized", folder)
    return next((place for place in places if all((place / n).is_file() for n in (INTRINSICS, EXTRINSICS))), None)


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split: the first camera in the order of names is held out for ``test`` and ``val`` alike. Times are
    those in the names of images.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    place = _cameras_in(folder)
    assert place is not None, "recognises(folder)"
    inner, outer = _read_yaml(place / INTRINSICS), _read_yaml(place / EXTRINSICS)
    names = inner.get("names")
    if not isinstance(names, list) or not names:
        raise UserError(f"{place / INTRINSICS}: names is missing or empty; list the cameras there")
    cameras = []
    for name in dict.fromkeys(names):
        if name in ("", ".", "..") or "/" in name or "\\" in name or "\0" in name:
            raise UserError(f"{place / INTRINSICS}: names lists {name[:60]!r}, no name of a folder; correct it")
        lens, size = _lens(place / INTRINSICS, inner, name)
        fitted = partial(fitted_lens, f"{place / INTRINSICS}: camera {name}", lens, size)
        files = images_in(folder / "images" / name) or images_in(folder / name)
        cameras.append(RigCamera(name, _viewmat(place / EXTRINSICS, outer, name), fitted, files))
    return read_rig(place / INTRINSICS, folder, cameras, split, options)


def _viewmat(path: Path, fields: dict[str, np.ndarray | list[str]], name: str) -> np.ndarray:
    """Return the world-to-camera matrix [4, 4] of a camera."""
    viewmat = np.eye(4)
    key = f"Rot_{name}" if f"Rot_{name}" in fields else f"R_{name}"
    rotation = _numbers(path, fields, key, 9 if key.startswith("Rot_") else 3)
    viewmat[:3, :3] = rotation.reshape(3, 3) if len(rotation) == 9 else Rotation.from_rotvec(rotation).as_matrix()
    if not is_rotation(viewmat[:3, :3]):
        raise UserError(f"{path}: {key} is no rotation; restore the file")
    viewmat[:3, 3] = _numbers(path, fields, f"T_{name}", 3)
    return viewmat


def _lens(path: Path, fields: dict[str, np.ndarray | list[str]], name: str) -> tuple[Lens, tuple[int, int] | None]:
    """Return the lens of a camera, and the (width, height) of its images; None if it does not state one."""
    K = _numbers(path, fields, f"K_{name}", 9).reshape(3, 3)
    if K[0, 0] <= 0 or K[1, 1] <= 0 or np.abs(K[2] - (0, 0, 1)).max() > 1e-6:
        raise UserError(f"{path}: K_{name} is not a 3 x 3 matrix of intrinsics in pixels; correct the camera")
    key = f"dist_{name}" if f"dist_{name}" in fields else f"D_{name}"
    k1, k2, p1, p2, k3 = (*_numbers(path, fields, key, 4, 5), 0.0)[:5] if key in fields else [0.0] * 5
    both = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    try:
        lens = make_lens("FULL_OPENCV", (*both, *map(float, (k1, k2, p1, p2, k3)), 0.0, 0.0, 0.0), float(K[0, 1]))
    except ValueError as error:
        raise UserError(f"{path}: camera {name}: {error}; correct the camera") from None
    if not lens.distorted:
        lens = Lens(*both)
    sides = [float(_numbers(path, fields, f"{s}_{name}", 1)[0]) if f"{s}_{name}" in fields else -1.0 for s in "WH"]
    if not all(1.0 <= side <= LARGEST_SIDE and side == int(side) for side in sides):
        return lens, None
    return lens, (int(sides[0]), int(sides[1]))


def _numbers(path: Path, fields: dict[str, np.ndarray | list[str]], key: str, *counts: int) -> np.ndarray:
    values = fields.get(key)
    if not isinstance(values, np.ndarray) or len(values) not in counts or not (np.abs(values) < MAX_NUMBER).all():
        raise UserError(f"{path}: {key} is missing, or no {counts[-1]} finite numbers; restore the file")
    return values


def _read_yaml(path: Path) -> dict[str, np.ndarray | list[str]]:
    """Read what OpenCV writes as YAML: by key, the numbers of a matrix or of a single value, or a list of texts."""
    try:
        lines = read_text(path, MAX_TEXT_BYTES).splitlines()
    except (OSError, UnicodeDecodeError):
        raise UserError(f"{path}: cannot be read as text; restore the file") from None
    bodies: dict[str, list[str]] = {}
    body: list[str] = []
    for line in lines:
        match = KEY.fullmatch(line.rstrip())
        if match is not None and not line.startswith("%"):
            body = bodies.setdefault(match[1], [])
            body.clear()
            body.append(match[2])
        else:
            body.append(line)
    return {key: _value(path, key, " ".join(body)) for key, body in bodies.items()}


def _value(path: Path, key: str, text: str) -> np.ndarray | list[str]:
    if "!!opencv-matrix" in text:
        _, begun, text = text.partition("data:")
        text = text.strip()
        if not begun or not (text.startswith("[") and text.endswith("]")):
            raise UserError(f"{path}: {key} has no data; restore the file")
        text = text[1:-1].replace(",", " ")
    elif key == "names":
        listed = text.strip().removeprefix("[").removesuffix("]").replace(",", " ")
        return [word.strip("\"'") for word in listed.split() if word != "-"]
    try:
        return np.array([float(word) for word in text.split()], np.float64)
    except ValueError:
        return [text]
