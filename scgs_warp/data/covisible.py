"""Masks of what training images show as well, for scores of held-out views that do not count what nobody saw."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from ..errors import UserError
from .depth_maps import has_proportions
from .images import decode, size_text
from .lens import Lens, undistortion_maps


def read_covisible(path: Path, source: tuple[int, int], size: tuple[int, int], lens: Lens | None = None) -> Tensor:
    """Read a mask: [H, W] bool, True where it is not black. It may be smaller or larger than its image.

    Args:
        source: (width, height) of the file of the image.
        size: (width, height) that the image has now.
        lens: lens of an image with distortion; the mask is then undistorted as its image is.

    Raises:
        UserError: the file is missing or does not decode, or has other proportions than the image.
    """
    seen = (decode(path)[..., :3].max(axis=2) > 0).astype(np.uint8)
    if not has_proportions(seen.shape[::-1], source):
        raise UserError(
            f"{path}: is {size_text(seen.shape[::-1])}, but its image {size_text(source)}; give it the proportions of "
            "the image"
        )
    if lens is not None:
        columns, rows, valid = undistortion_maps(lens, *source)
        whole = cv2.resize(seen, source, interpolation=cv2.INTER_NEAREST_EXACT)
        seen = np.where(valid, cv2.remap(whole, columns, rows, cv2.INTER_NEAREST), np.uint8(0))
    return torch.from_numpy(cv2.resize(seen, size, interpolation=cv2.INTER_NEAREST_EXACT) > 0)
