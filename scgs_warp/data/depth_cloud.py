"""Points of a depth map: where the surfaces are that the pixels of an image show."""

from __future__ import annotations

import cv2
import numpy as np

RANGE = 20.0
"""Depth gives points between the median divided by this and multiplied by it: sky and unknown depth do not."""
EDGE = 0.1
"""Relative difference of depth within 3 x 3 pixels beyond which they lie on an outline, where depth is blurred."""


def depth_cloud(
    depth: np.ndarray, image: np.ndarray, K: np.ndarray, viewmat: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return up to about ``most`` points [P, 3] in world units and their colours [P, 3], evenly over the image.

    Args:
        depth: [h, w] along the camera's z, world units, 0 where unknown; of any size with the proportions of the image.
        image: [H, W, 3] of any type, which is that of the colours.
        K: [3, 3] intrinsics in pixels of the image.
        viewmat: [4, 4] world-to-camera, OpenCV.
    """
    known = depth > 0
    middle = float(np.median(depth[known])) if known.any() else 0.0
    known &= (depth > middle / RANGE) & (depth < middle * RANGE)
    safe = np.where(known, depth, np.inf).astype(np.float32)
    around = np.ones((3, 3))
    low = cv2.erode(safe, around)
    high = cv2.dilate(np.where(known, depth, 0.0).astype(np.float32), around)
    known &= (high - low) < EDGE * safe
    rows, columns = np.nonzero(known)
    every = max(1, int(np.ceil(len(rows) / max(most, 1))))
    rows, columns = rows[::every], columns[::every]
    sx, sy = image.shape[1] / depth.shape[1], image.shape[0] / depth.shape[0]
    x, y, z = (columns + 0.5) * sx, (rows + 0.5) * sy, depth[rows, columns]
    local = np.stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z], 1)
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    pixels = np.floor(y).astype(int).clip(0, image.shape[0] - 1), np.floor(x).astype(int).clip(0, image.shape[1] - 1)
    return (local - translation) @ rotation, image[pixels]
