"""The fundamental matrix between two images."""

from __future__ import annotations

import cv2
import numpy as np

METHODS = (cv2.USAC_MAGSAC, cv2.FM_RANSAC)
"""Ways to estimate it, best first. OpenCV 5 fails in the first one where points hardly leave a plane."""
CONFIDENCE, ITERATIONS = 0.999, 2000


def fundamental_matrix(
    starts: np.ndarray, targets: np.ndarray, error: float
) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """Estimate the fundamental matrix [3, 3] of point pairs [N, 2], some of which may be wrong.

    Args:
        error: largest distance of a right pair from its epipolar lines, pixels.

    Returns:
        The matrix, and [N] bool, True for the pairs that fit; None and None if there is none.
    """
    for method in METHODS:
        try:
            matrix, inside = cv2.findFundamentalMat(starts, targets, method, error, CONFIDENCE, ITERATIONS)
        except cv2.error:
            continue
        return (None, None) if matrix is None or matrix.shape != (3, 3) else (matrix, inside.ravel() > 0)
    return None, None
