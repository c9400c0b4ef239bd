"""Unit quaternions as the index of their largest component, which is made positive, and the other three."""

from __future__ import annotations

import math

import numpy as np

LIMIT = math.sqrt(0.5)
"""Largest magnitude of the three."""
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Indices of the three, for each index of the largest."""


def split(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices [N] int64 of the largest components of unit quaternions [N, 4], and the others [N, 3]."""
    largest = np.abs(quats).argmax(axis=1)
    signs = np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    return largest, signs * np.take_along_axis(quats, OTHERS[largest], 1)


def join(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return quaternions [N, 4], the inverse of :func:`split`; others longer than 1 leave a largest component of 0."""
    quats = np.empty((len(largest), 4))
    np.put_along_axis(quats, OTHERS[largest], others, 1)
    remaining = np.sqrt(np.maximum(1.0 - (others**2).sum(axis=1), 0.0))
    np.put_along_axis(quats, largest[:, None].astype(np.int64), remaining[:, None], 1)
    return quats
