"""Dense optical flow between two images, and where it can be trusted."""

from __future__ import annotations

import cv2
import numpy as np

MIN_CONTRAST = 4.0
"""Smallest local contrast, in grey levels, at which flow is trusted."""
CONTRAST_SIDE = 9
"""Side of the squares in which contrast is measured, pixels."""


def dense_flow(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Return the flow [H, W, 2] (x, y), float32 pixels, from image ``one`` to image ``two``, both [H, W] uint8: dense
    inverse search (Kroeger et al. 2016).

    OpenCV searches in as many strips as it has threads, and neighbours help each other within a strip only. One thread
    gives the same bits on every machine.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        search.setFinestScale(0)
        return search.calc(one, two, None)  # type: ignore[call-overload]
    finally:
        cv2.setNumThreads(before)


def at_targets(values: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Sample ``values`` [H, W, ...] at pixel positions ``targets`` [h, w, 2], bilinearly; beyond the border at it."""
    x, y = np.ascontiguousarray(targets[..., 0]), np.ascontiguousarray(targets[..., 1])
    return cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def targets_of(flow: np.ndarray) -> np.ndarray:
    """Return the pixel positions [H, W, 2] in the other image to which a flow [H, W, 2] leads; the centre of the first
    pixel is at (0, 0)."""
    height, width = flow.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return np.stack([x, y], 2) + flow


def returns(forth: np.ndarray, back: np.ndarray, most: float) -> np.ndarray:
    """Tell where flow forth and back leads to within ``most`` pixels of where it began, inside the other image; it does
    not where a surface is hidden in the other image. [H, W] bool."""
    height, width = forth.shape[:2]
    targets = targets_of(forth)
    inside = (targets >= 0).all(2) & (targets[..., 0] <= width - 1) & (targets[..., 1] <= height - 1)
    return inside & (np.square(forth + at_targets(back, targets)).sum(2) < most**2)


def textured(image: np.ndarray) -> np.ndarray:
    """Tell where an image [H, W] uint8 has contrast enough for flow to follow; [H, W] bool."""
    values = image.astype(np.float32)
    side = (CONTRAST_SIDE, CONTRAST_SIDE)
    mean = cv2.boxFilter(values, -1, side)
    variance = cv2.boxFilter(values * values, -1, side) - mean * mean
    return variance > MIN_CONTRAST**2
