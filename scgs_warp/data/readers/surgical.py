"""What EndoNeRF's data add to the layout of LLFF, as the films of operations by others in its layout do (SCARED,
StereoMIS): masks of the tools and depth by stereo.

``images``, ``masks`` (white on tools, which are no part of the scene) and ``depth`` (whole numbers along the camera's
z, in the units of the poses, in 8 or 16 bits; 0 where unknown) hold one file for each row of ``poses_bounds.npy``, in
the same order of names. Unlike in LLFF's, the columns of a rotation in this file are (right, up, backwards).
Layout: Wang et al., EndoNeRF, MICCAI 2022.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..dataset import Dataset, spread
from .transforms import IMAGE_SUFFIXES

MASKS, DEPTH = "masks", "depth"
SAMPLED, LEAST_LEFT = 8, 0.5
"""Number of frames whose masks are looked at, and the share of their pixels that tools leave at least."""


class Surgical(NamedTuple):
    """Files of an operation's film, one for each row."""

    masks: list[Path]
    """White on tools."""
    depth: list[Path]


def find_surgical(folder: Path, count: int) -> Surgical | None:
    """Return the masks and depth maps of ``count`` images; None without one of each for every image."""
    found = Surgical(*(_files(folder / name) for name in (MASKS, DEPTH)))
    return found if len(found.masks) == len(found.depth) == count else None


def notes_of_masks(folder: Path, data: Dataset) -> tuple[str, ...]:
    """Return a note if most of what the frames show is masked, as by masks that are white on the scene instead."""
    masks = [data[index].mask for index in spread(len(data), SAMPLED)]
    left = float(np.mean([1.0 if mask is None else float(mask.float().mean()) for mask in masks]))
    if left >= LEAST_LEFT:
        return ()
    line = (
        f"{folder / MASKS}: leave {left:.0%} of the pixels; they are white on tools: invert them if white is the scene"
    )
    return (line,)


def _files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    files = (
        file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".")
    )
    return sorted(files, key=lambda file: file.name)


def as_llff(rows: np.ndarray) -> np.ndarray:
    """Return rows [C, 17] whose rotations have LLFF's columns, (down, right, backwards)."""
    poses = rows[:, :15].reshape(-1, 3, 5)
    right, up = poses[:, :, 0], poses[:, :, 1]
    turned = np.concatenate([np.stack([-up, right], axis=2), poses[:, :, 2:]], axis=2)
    return np.concatenate([turned.reshape(-1, 15), rows[:, 15:]], axis=1)
