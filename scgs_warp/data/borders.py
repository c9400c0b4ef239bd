"""Detection of the black borders that undistortion leaves in a video."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

BLACK_LEVEL = 4 / 255
"""Largest channel value, in [0, 1], of a black pixel: JPEG compression lifts black borders slightly."""
MIN_FRAME_SHARE = 0.9
"""Share of the frames in which a border pixel must be black, so that dark objects that pass by are not masked."""
MIN_FRAMES = 4
"""Smallest number of frames in which a border can be detected."""
MAX_AREA = 0.2
"""Largest share of the image that a border covers. If black pixels cover more, or the middle of the image, they are the
scene's background."""


def border_mask(images: Sequence[np.ndarray]) -> np.ndarray | None:
    """Find the border: pixels that are black in nearly all images and connected to the edge of the image.

    Args:
        images: [H, W, 3], all of one size, uint8 or uint16, sampled from the whole video.

    Returns:
        [H, W] bool, False on the border and on the pixels next to it, which interpolation has darkened. None if there
        is no border, if there are too few images, or if their sizes differ.
    """
    if len(images) < MIN_FRAMES or len({image.shape for image in images}) != 1:
        return None
    black = np.zeros(images[0].shape[:2], np.float32)
    for image in images:
        black += image[..., :3].max(axis=2) <= BLACK_LEVEL * np.iinfo(image.dtype).max
    dark = (black >= MIN_FRAME_SHARE * len(images)).astype(np.uint8)
    _, labels = cv2.connectedComponents(dark, connectivity=8)
    edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    border = np.isin(labels, edge[edge > 0])
    height, width = border.shape
    middle = border[height // 4 : height - height // 4, width // 4 : width - width // 4]
    if not border.any() or border.mean() > MAX_AREA or middle.any():
        return None
    return cv2.dilate(border.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0


def reduce_mask(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Reduce ``mask`` [H, W] bool to ``size`` (w, h): True where every covered pixel is True."""
    if size == (mask.shape[1], mask.shape[0]):
        return mask
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 1.0 - 1e-4
