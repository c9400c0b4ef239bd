"""Morton order: points along a curve that keeps neighbours together."""

from __future__ import annotations

import numpy as np


def morton_order(points: np.ndarray, bits: int = 10) -> np.ndarray:
    """Return indices [N] int64 that sort finite points [N, 3] by their cells' Morton codes.

    Args:
        bits: 1 to 21; the bounding box has 2 ** bits cells along each axis.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    cells = ((points - low) / np.maximum(high - low, 1e-12) * ((1 << bits) - 1)).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(bits):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")
