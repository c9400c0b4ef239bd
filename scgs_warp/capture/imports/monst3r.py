"""Folders of MonST3R: ``pred_traj.txt``, ``pred_intrinsics.txt``, ``frame_0000.png`` and ``frame_0000.npy``.

A row of ``pred_traj.txt`` holds a frame's number, the camera's position, and its camera-to-world rotation as a
quaternion w x y z; a row of ``pred_intrinsics.txt`` holds the nine numbers of K. ``frame_NNNN.npy`` is the depth, and
``conf_N.npy`` its confidence. Cameras are OpenCV's. Layout: Zhang et al., MonST3R, ICLR 2025.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ...data.natural_order import natural
from ...errors import UserError
from ...storage.files import read_text
from ...storage.numpy_files import read_npy
from .scene import ImportedFrame, ImportedScene, intrinsics, rigid, surer
from .stacks import MAX_FRAMES

TRAJECTORY, INTRINSICS = "pred_traj.txt", "pred_intrinsics.txt"
MAX_TEXT_BYTES = 1 << 24


def recognises(path: Path) -> bool:
    """Return whether the folder holds this layout."""
    return (path / TRAJECTORY).is_file()


def read(path: Path) -> ImportedScene:
    """Read a scene.

    Raises:
        UserError: a file is missing, damaged or does not fit; one line names it.
    """
    rows, lenses = read_table(path / TRAJECTORY, 8), read_table(path / INTRINSICS, 9)
    files = sorted(path.glob("frame_*.png"), key=lambda file: natural(file.name))
    if len(rows) != len(files) or len(lenses) not in (1, len(files)):
        raise UserError(
            f"{path}: {TRAJECTORY} has {len(rows)} rows and {INTRINSICS} {len(lenses)}, but there are {len(files)} "
            "images frame_NNNN.png; export the scene again"
        )
    frames = []
    for index, (file, row) in enumerate(zip(files, rows)):
        where = f"{path / TRAJECTORY}: row {index}"
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = quaternion_matrix(row[4:8], where), row[1:4]
        K = intrinsics(lenses[index % len(lenses)].reshape(3, 3), f"{path / INTRINSICS}: row {index % len(lenses)}")
        frames.append(ImportedFrame(file, np.linalg.inv(rigid(pose, where)), K, float(row[0]), _depth_of(file)))
    return ImportedScene("MonST3R", frames, gravity=False)


def _depth_of(image: Path) -> Callable[[], np.ndarray] | None:
    """Return a function that reads the depth of a frame; None if it has none."""
    file = image.with_suffix(".npy")
    number = image.stem.split("_")[-1]
    sureness = image.with_name(f"conf_{int(number)}.npy") if number.isascii() and number.isdigit() else None

    def load() -> np.ndarray:
        depth = read_npy(file)
        return depth if sureness is None or not sureness.is_file() else surer(depth, read_npy(sureness), str(sureness))

    return load if file.is_file() else None


def read_table(path: Path, columns: int) -> np.ndarray:
    """Read rows of numbers separated by blanks.

    Raises:
        UserError: the file is missing, or no such table.
    """
    try:
        lines = read_text(path, MAX_TEXT_BYTES).splitlines()
        rows = np.array([[float(word) for word in line.split()] for line in lines if line.strip()], np.float64)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; export the scene again") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); export the scene again") from None
    except ValueError:
        raise UserError(f"{path}: is no table of {columns} numbers a row; export the scene again") from None
    if rows.ndim != 2 or rows.shape[1] != columns or len(rows) > MAX_FRAMES or not np.isfinite(rows).all():
        raise UserError(f"{path}: is no table of {columns} numbers a row; export the scene again")
    return rows


def quaternion_matrix(wxyz: np.ndarray, where: str) -> np.ndarray:
    """Return the rotation [3, 3] of a quaternion, which need not be of length 1.

    Raises:
        UserError: its length is far from 1.
    """
    length = float(np.linalg.norm(wxyz)) if np.isfinite(wxyz).all() else 0.0
    if not 0.9 < length < 1.1:
        raise UserError(f"{where}: the quaternion is not of length 1; export the scene again")
    w, x, y, z = wxyz / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
