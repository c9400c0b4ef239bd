"""One frame of a film or a folder, and its reduction."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np


class SourceFrame(NamedTuple):
    """One frame of a source."""

    index: int
    """Index in the video or in the order of names, from 0."""
    seconds: float
    """Time since the first frame, seconds; for a folder, in units of the usual time between two images."""
    image: np.ndarray
    """[H, W, 3] uint8 RGB"""
    name: str
    """Name of the image file; empty for a video."""
    alpha: np.ndarray | None = None
    """[H, W] uint8; None for a picture without alpha."""
    turns: int = 0
    """Number of quarter turns, counter-clockwise, by which the picture was turned to have the others' size."""


def shrunk(image: np.ndarray, longest: int) -> np.ndarray:
    """Reduce the image, if necessary, so that its longer side has at most ``longest`` pixels."""
    scale = longest / max(image.shape[:2])
    if scale >= 1:
        return image
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
