"""The pinhole model: pixels of points, and rays of pixels.

Arrays are projected in float64 on the host, with the centre of the first pixel at (0, 0), where OpenCV has it; tensors
in their own precision, with that centre at (0.5, 0.5), where ``Camera`` has it.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from ..types import Camera


def projected(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Project points [P, 3]: pixels [P, 2], and the points in the camera's frame [P, 3]."""
    viewmat, K = camera.viewmat.to(points), camera.K.to(points)
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    flat = local @ K.T
    return flat[:, :2] / flat[:, 2:], local


def in_image(pixels: Tensor, local: Tensor, camera: Camera, nearest: float = 0.0) -> Tensor:
    """Tell which points, :func:`projected`, lie in the image and beyond the depth ``nearest``, [P] bool."""
    size = pixels.new_tensor([camera.width, camera.height])
    return (local[:, 2] > nearest) & ((pixels >= 0) & (pixels < size)).all(1)


def pixels_of(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project points [P, 3]: pixels [P, 2] and depths [P]; infinite or NaN where a depth is 0."""
    view, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    local = points @ view[:3, :3].T + view[:3, 3]
    flat = local @ K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return flat[:, :2] / flat[:, 2:] - 0.5, local[:, 2]


def ray_of(camera: Camera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the position [3] of a camera, and the unit directions [P, 3] of the rays through pixels [P, 2], world."""
    view, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    rays = np.concatenate([pixels + 0.5, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(K).T @ view[:3, :3]
    return -view[:3, :3].T @ view[:3, 3], rays / np.linalg.norm(rays, axis=1, keepdims=True)
