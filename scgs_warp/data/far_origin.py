"""Scenes far from the origin, as georeferenced cameras have: 32-bit numbers do not hold their coordinates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

FAR = 1e5
"""Distance from the origin, in world units, up to which scenes are taken as they are: 32 bits round it by 0.004."""
ROUNDING = 1e-4
"""Largest error of a camera's place by rounding to 32 bits, as a share of the cameras' extent."""


def offset_of(viewmats: Sequence[np.ndarray]) -> np.ndarray | None:
    """Return the place, [3] whole world units, to which a scene's origin should move; None if it may stay.

    Args:
        viewmats: [4, 4] float64 world-to-camera, of the cameras of all splits.
    """
    if not viewmats:
        return None
    stacked = np.stack(viewmats)
    centres = -np.einsum("vij,vi->vj", stacked[:, :3, :3], stacked[:, :3, 3])
    if not np.isfinite(centres).all():
        return None
    middle = np.median(centres, axis=0)
    distance, extent = np.abs(middle).max(), np.abs(centres - middle).max()
    far = distance > FAR and distance * np.finfo(np.float32).eps > ROUNDING * extent
    return np.rint(middle) if far else None


def moved(viewmat: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return the camera [4, 4] in a world whose origin is at ``offset``."""
    result = viewmat.copy()
    result[:3, 3] += viewmat[:3, :3] @ offset
    return result


def note(offset: np.ndarray) -> str:
    """Tell the user where the origin is."""
    x, y, z = (f"{value:.0f}" for value in offset)
    return f"the scene is far from the origin: ({x}, {y}, {z}) is subtracted from all cameras and points"
