"""Folders of networks that write a file for each frame: CUT3R's, Uni4D's, and those of Depth Anything 3's streaming
program.

CUT3R: ``camera/000000.npz`` with ``pose [4, 4]``, camera-to-world, and ``intrinsics [3, 3]``; ``color/000000.png``;
``depth/000000.npy [H, W]`` and ``conf/000000.npy [H, W]``. DA3-Streaming: ``results_output/frame_0.npz`` with ``image
[H, W, 3]`` bytes, ``depth`` and ``conf [H, W]`` and ``intrinsics [3, 3]``; a row of 16 numbers for each frame in
``camera_poses.txt``, the camera-to-world matrix. Uni4D: ``0000.npz`` with ``img [H, W, 3]`` bytes, ``disp [H, W]``, the
inverse of the depth, ``K [3, 3]``, and ``R [3, 3]`` and ``t [3]``, camera-to-world. Cameras are OpenCV's.
Layouts: Wang et al., CUT3R, CVPR 2025; Lin et al., Depth Anything 3, 2025; Yao et al., Uni4D, CVPR 2025.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from ...data.natural_order import natural
from ...errors import UserError
from ...storage.numpy_files import read_npy
from ..folder_content import is_shown
from .monst3r import read_table
from .scene import ImportedFrame, ImportedScene, intrinsics, rigid, surer
from .stacks import SMALLEST, members

POSES, RESULTS = "camera_poses.txt", "results_output"
UNI4D = {"img", "disp", "K", "R", "t"}
"""Arrays of a frame of Uni4D."""


def is_cut3r(path: Path) -> bool:
    """Return whether the folder is an output of CUT3R."""
    return (path / "color").is_dir() and any((path / "camera").glob("*.npz"))


def read_cut3r(path: Path) -> ImportedScene:
    """Read an output of CUT3R; frames without an image are left out.

    Raises:
        UserError: a file is missing, damaged or does not fit; one line names it.
    """
    frames, files = [], _files(path / "camera")
    for number, file in enumerate(files):
        image = path / "color" / f"{file.stem}.png"
        if not image.is_file():
            continue
        pose = rigid(read_npy(file, "pose"), f"{file}: pose")
        K = intrinsics(read_npy(file, "intrinsics"), f"{file}: intrinsics")
        depth, sureness = (path / kind / f"{file.stem}.npy" for kind in ("depth", "conf"))
        load = partial(_depth, depth, sureness) if depth.is_file() else None
        moment = float(int(file.stem)) if file.stem.isdecimal() and len(file.stem) < 19 else float(number)
        frames.append(ImportedFrame(image, np.linalg.inv(pose), K, moment, load))
    missing = len(files) - len(frames)
    note = f"{missing} of {len(files)} cameras have no image in color, and are left out" if missing else None
    return ImportedScene("CUT3R", frames, gravity=False, note=note)


def is_streaming(path: Path) -> bool:
    """Return whether the folder is an output of DA3-Streaming."""
    return (path / POSES).is_file() and any((path / RESULTS).glob("frame_*.npz"))


def read_streaming(path: Path) -> ImportedScene:
    """Read an output of DA3-Streaming.

    Raises:
        UserError: a file is missing, damaged or does not fit; one line names it.
    """
    rows, files = read_table(path / POSES, 16), _files(path / RESULTS)
    if len(rows) != len(files):
        raise UserError(
            f"{path}: {POSES} has {len(rows)} rows, but {RESULTS} holds {len(files)} frames; export the scene again"
        )
    frames = []
    for index, (row, file) in enumerate(zip(rows, files)):
        pose = rigid(row.reshape(4, 4), f"{path / POSES}: row {index}")
        K = intrinsics(read_npy(file, "intrinsics"), f"{file}: intrinsics")
        load = partial(_saved_depth, file) if "depth" in members(file) else None
        frames.append(ImportedFrame(partial(_saved_image, file), np.linalg.inv(pose), K, float(index), load))
    return ImportedScene("DA3-Streaming", frames, gravity=False)


def is_uni4d(path: Path) -> bool:
    """Return whether the folder is an output of Uni4D."""
    files = [file for file in _files(path) if file.stem.isdecimal()]
    return bool(files) and UNI4D <= members(files[0])


def read_uni4d(path: Path) -> ImportedScene:
    """Read an output of Uni4D; other files, such as that of the fused points, do not count.

    Raises:
        UserError: a file is damaged or does not fit; one line names it.
    """
    frames = []
    for index, file in enumerate(file for file in _files(path) if file.stem.isdecimal()):
        rotation, position = read_npy(file, "R"), read_npy(file, "t")
        if rotation.shape != (3, 3) or position.size != 3:
            raise UserError(f"{file}: R and t are no pose of 3 x 3 and 3 numbers; export the scene again")
        pose = rigid(np.column_stack([rotation, position.ravel()]), f"{file}: R and t")
        K = intrinsics(read_npy(file, "K"), f"{file}: K")
        load = partial(_inverse_of, file)
        frames.append(ImportedFrame(partial(_saved_image, file, "img"), np.linalg.inv(pose), K, float(index), load))
    return ImportedScene("Uni4D", frames, gravity=False)


def _files(folder: Path) -> list[Path]:
    return sorted(filter(is_shown, folder.glob("*.npz")), key=lambda file: natural(file.name))


def _depth(path: Path, sureness: Path) -> np.ndarray:
    """Read the depth [H, W] of a frame, 0 where it is least sure."""
    depth = read_npy(path)
    return surer(depth, read_npy(sureness), str(sureness)) if sureness.is_file() else depth


def _saved_depth(file: Path) -> np.ndarray:
    """Read the depth [H, W] of a frame that one file holds, 0 where it is least sure."""
    depth = read_npy(file, "depth")
    return surer(depth, read_npy(file, "conf"), f"{file}: conf") if "conf" in members(file) else depth


def _inverse_of(file: Path) -> np.ndarray:
    """Read the depth [H, W] of a frame whose file holds its inverse."""
    with np.errstate(divide="ignore"):  # what is infinitely far away is unknown
        return 1.0 / read_npy(file, "disp")


def _saved_image(file: Path, key: str = "image") -> np.ndarray:
    """Read the image [H, W, 3] uint8 of a frame that one file holds."""
    image = read_npy(file, key)
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < SMALLEST:
        raise UserError(f"{file}: {key} is {list(image.shape)}, not [H, W, 3]; export the scene again")
    if not (image.min() >= 0.0 and image.max() <= 255.0):  # False for NaN
        raise UserError(f"{file}: {key} holds other numbers than 0 to 255; export the scene again")
    return np.ascontiguousarray(np.rint(image).astype(np.uint8))


LAYOUTS: tuple[tuple[Callable[[Path], bool], Callable[[Path], ImportedScene]], ...] = (
    (is_cut3r, read_cut3r),
    (is_streaming, read_streaming),
    (is_uni4d, read_uni4d),
)
