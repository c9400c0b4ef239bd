"""Pixels of points and rays of pixels, in float64 on the host."""

from __future__ import annotations

import numpy as np

from ..types import Camera


def pixels_of(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project points [P, 3]: pixels [P, 2], the centre of the first at (0, 0), and depths [P]."""
    view, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    local = points @ view[:3, :3].T + view[:3, 3]
    flat = local @ K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return flat[:, :2] / flat[:, 2:] - 0.5, local[:, 2]


def ray_of(camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the position [3] of a camera, and the unit directions [P, 3] of pixels [P, 2]."""
    view, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    rays = np.concatenate([pixels + 0.5, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(K).T @ view[:3, :3]
    return -view[:3, :3].T @ view[:3, 3], rays / np.linalg.norm(rays, axis=1, keepdims=True)
