"""Depth maps of frames, as nerfstudio's layout names them: ``depth_file_path`` of a frame, a PNG, ``.npy``, ``.exr``,
or ``.npz`` with an array ``depth``.

Values along the camera's z are multiplied by ``depth_unit_scale_factor`` (0.001 if it is absent: 16-bit PNG in
millimetres) and are then in the units of the poses; 0 and non-finite values are unknown.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..errors import UserError
from ..storage.exr_files import read_exr
from ..storage.numpy_files import read_npy
from .images import decode
from .lens import Lens, undistortion_maps

MILLIMETRE = 0.001
"""Unit of maps that state none, in units of the poses."""
REMEDY = "save it as 16-bit grey PNG or as .npy [h, w]"
MOST_DIFFERENT = 0.02
"""Largest relative difference between the proportions of a map and of its image."""


class DepthFile(NamedTuple):
    """Where a depth map is."""

    path: Path
    unit: float
    """Factor on the values of the file."""
    whole: bool = False
    """Whether maps of 8 bits, which hold whole numbers up to 255, count as depth."""


def read_depth_map(file: DepthFile, size: tuple[int, int], lens: Lens | None = None) -> Tensor:
    """Read a depth map: [h, w] float32 in the units of the poses, 0 where unknown.

    Args:
        size: (width, height) of the image, whose proportions the map must have.
        lens: lens of an image with distortion; the map is then undistorted as its image is, and gets its size.

    Raises:
        UserError: the file is missing or no depth map, or does not fit the image.
    """
    path = file.path
    values = _values(path)
    if values.ndim == 3 and values.size and (values.shape[2] == 1 or (values == values[..., :1]).all()):
        values = values[..., 0]
    if values.ndim != 2 or not values.size or (values.dtype == np.uint8 and not file.whole):
        raise UserError(f"{path}: is no depth map of one number per pixel; {REMEDY}")
    height, width = values.shape
    if not has_proportions((width, height), size):
        raise UserError(
            f"{path}: is {width} x {height}, but its image {size[0]} x {size[1]}; give it the proportions of the image"
        )
    with np.errstate(invalid="ignore", over="ignore"):
        depth = values.astype(np.float32) * np.float32(file.unit)
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0.0))
    if lens is not None:
        columns, rows, valid = undistortion_maps(lens, *size)
        whole = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
        depth = np.where(valid, cv2.remap(whole, columns, rows, cv2.INTER_NEAREST), np.float32(0.0))
    return torch.from_numpy(np.ascontiguousarray(depth))


def has_proportions(size: tuple[int, int], image: tuple[int, int]) -> bool:
    """Tell whether a map of (width, height) has the proportions of its image."""
    return abs(size[0] * image[1] / (size[1] * image[0]) - 1.0) <= MOST_DIFFERENT


def _values(path: Path) -> np.ndarray:
    if not path.is_file():
        raise UserError(f"{path}: no such depth map, though a frame names it; restore it or remove depth_file_path")
    if path.suffix.lower() in (".npy", ".npz"):
        return read_npy(path, "depth" if path.suffix.lower() == ".npz" else None)
    if path.suffix.lower() == ".exr":
        return read_exr(path)
    try:
        return decode(path)
    except UserError:
        raise UserError(f"{path}: does not decode as a depth map; {REMEDY}") from None
