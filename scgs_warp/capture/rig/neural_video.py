"""The layout of Neural 3D Video: ``poses_bounds.npy`` beside one video per camera, unpacked to images."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...data.points import write_points
from ...data.readers.poses_bounds import FILE as POSES
from ...data.readers.poses_bounds import POINTS, read_rows, row_lens, row_viewmat
from ...errors import UserError
from ...runtime.progress import ShowProgress
from ...storage.files import read_bytes, write_atomically
from .cameras import RigCamera


class KnownCameras(NamedTuple):
    """Cameras of ``poses_bounds.npy``."""

    path: Path
    rows: np.ndarray
    """[C, 17]"""

    def cameras(self, size_of: Callable[[int], tuple[int, int]]) -> dict[int, RigCamera]:
        """Return the cameras for frames of the given sizes (width, height)."""
        made = {}
        for number, row in enumerate(self.rows):
            pose, size = row[:15].reshape(3, 5), size_of(number)
            lens = row_lens(self.path, number, pose[:, 4], size)
            params = (lens.fx, lens.fy, lens.cx, lens.cy)
            made[number] = RigCamera("PINHOLE", params, *size, row_viewmat(self.path, number, pose))
        return made


def known_cameras(folder: Path, names: list[str]) -> KnownCameras | None:
    """Read ``poses_bounds.npy`` of the folder; return None without this file.

    Raises:
        UserError: the file is damaged, or has another number of cameras than there are videos.
    """
    path = folder / POSES
    if not path.is_file():
        return None
    rows = read_rows(path)
    if len(rows) != len(names):
        raise UserError(
            f"{path}: has {len(rows)} rows, but {folder} holds {len(names)} videos ({names[0]} to "
            f"{names[-1]}); give each camera a row and a video"
        )
    return KnownCameras(path, rows)


def write_neural_video(
    folder: Path,
    source: Path,
    names: list[str],
    instants: int,
    picture_file: Callable[[int, int], Path],
    points: tuple[np.ndarray, np.ndarray],
    show: ShowProgress,
) -> None:
    """Write ``CAMERA/images/0000.png``, points, and then ``poses_bounds.npy``, whose presence marks a complete folder.

    Args:
        source: folder of the videos.
        names: names of the cameras, in the order of the rows.
        instants: number of frames of each camera.
        picture_file: function from the numbers of a camera and an instant to the file of the image, a PNG.
        points: initial points and colours, world units of the poses.
        show: shows progress.
    """
    with show(len(names) * instants, "writing images") as bar:
        for number, name in enumerate(names):
            images = folder / name / "images"
            images.mkdir(parents=True, exist_ok=True)
            for instant in range(instants):
                _link(picture_file(number, instant), images / f"{instant:04d}.png")
                bar.advance()
    write_points(folder / POINTS[0], *points)
    write_atomically(folder / POSES, read_bytes(source / POSES, "put it beside the videos again"))


def _link(source: Path, target: Path) -> None:
    """Make a file available under a second name: thousands of images need no second copy."""
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:  # The file system has no hard links.
        shutil.copyfile(source, target)
