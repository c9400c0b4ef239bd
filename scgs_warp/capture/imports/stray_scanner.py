"""Recordings of Stray Scanner, an app that logs what ARKit says beside the film.

``rgb.mp4``; ``odometry.csv``, a table with a header and the columns ``timestamp`` (seconds), ``frame``, ``x, y, z`` and
``qx, qy, qz, qw`` (camera-to-world, the camera's axes OpenCV's, y up in the world) and, of newer versions, ``fx, fy,
cx, cy``; ``camera_matrix.csv``, the nine numbers of K; ``depth/000000.png`` in millimetres; ``confidence/000000.png``,
0 to 2. Layout: docs/format.md of the app's repository.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...errors import UserError
from ...storage.files import read_text
from ..source import Video
from .film_pictures import MOST_FRAMES, FilmPictures
from .monst3r import MAX_TEXT_BYTES, quaternion_matrix
from .phone_apps import depth_of
from .scene import Y_UP_TO_Z_UP, ImportedFrame, ImportedScene, intrinsics, rigid

FILM, TRACK, LENS = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
POSE = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
INTRINSICS = ("fx", "fy", "cx", "cy")


def recognises(path: Path) -> bool:
    """Return whether the folder is a recording of Stray Scanner."""
    return (path / TRACK).is_file() and (path / FILM).is_file()


def read(path: Path) -> ImportedScene:
    """Read a recording; of more than ``MOST_FRAMES`` frames, every second, third or so is taken.

    Raises:
        UserError: a file is missing, damaged or does not fit; one line names it.
    """
    film = Video(path / FILM)
    columns = _columns(path / TRACK)
    numbers = columns["frame"].astype(np.int64)
    if (np.diff(numbers) <= 0).any() or numbers[0] < 0:
        raise UserError(f"{path / TRACK}: frame does not rise from row to row; export the recording again")
    filmed = int((numbers < film.count).sum())
    rows = range(0, filmed, -(-max(filmed, 1) // MOST_FRAMES))
    pictures = FilmPictures(film, [int(numbers[row]) for row in rows])
    frames = []
    for row in rows:
        where, number = f"{path / TRACK}: row {row}", int(numbers[row])
        pose = np.eye(4)
        pose[:3, :3] = quaternion_matrix(np.array([columns[name][row] for name in ("qw", "qx", "qy", "qz")]), where)
        pose[:3, 3] = [columns[name][row] for name in "xyz"]
        frames.append(
            ImportedFrame(
                lambda number=number: pictures.at(number),
                np.linalg.inv(Y_UP_TO_Z_UP @ rigid(pose, where)),
                _lens(path, columns, row),
                float(columns["timestamp"][row]),
                depth_of(*(path / kind / f"{number:06d}.png" for kind in ("depth", "confidence"))),
            )
        )
    notes = [f"{len(rows)} of {filmed} frames are taken"] if len(rows) < filmed else []
    if filmed < len(numbers):
        notes.append(f"{len(numbers) - filmed} of {len(numbers)} poses have no picture in {FILM}, and are left out")
    return ImportedScene("Stray Scanner", frames, gravity=True, note="; ".join(notes) or None)


def _columns(path: Path) -> dict[str, np.ndarray]:
    """Read the columns of a table by the names in its header.

    Raises:
        UserError: the file is no such table.
    """
    try:
        lines = [line for line in read_text(path, MAX_TEXT_BYTES).splitlines() if line.strip()]
        names = [name.strip() for name in lines[0].split(",")]
        table = np.array([[float(word) for word in line.split(",")] for line in lines[1:]], np.float64)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); export the recording again") from None
    except (ValueError, IndexError):
        raise UserError(f"{path}: is no table of numbers with a header; export the recording again") from None
    missing = [name for name in POSE if name not in names]
    if missing or table.ndim != 2 or table.shape[1] != len(names) or not np.isfinite(table).all():
        fault = f"has no column {missing[0]}" if missing else "is no table of numbers with a header"
        raise UserError(f"{path}: {fault}; export the recording again")
    if np.abs(table[:, names.index("frame")]).max() > 1e9:
        raise UserError(f"{path}: frame is beyond all films; export the recording again")
    return dict(zip(names, table.T))


def _lens(path: Path, columns: dict[str, np.ndarray], row: int) -> np.ndarray:
    """Return the matrix K [3, 3] of a row: its own, or that of the whole recording."""
    if all(name in columns for name in INTRINSICS):
        fx, fy, cx, cy = (columns[name][row] for name in INTRINSICS)
        return intrinsics(np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), f"{path / TRACK}: row {row}")
    try:
        words = read_text(path / LENS, MAX_TEXT_BYTES).replace(",", " ").split()
        return intrinsics(np.array([float(word) for word in words]).reshape(3, 3), str(path / LENS))
    except (OSError, ValueError):
        raise UserError(f"{path / LENS}: holds no nine numbers; export the recording again") from None
