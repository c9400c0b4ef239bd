"""Depth of the surface of Gaussians in float64: the opacity accumulated along one ray, and where it reaches a level."""

from __future__ import annotations

import numpy as np

from reference.projection import Projected
from scgs_warp.types import Camera, Gaussians

ALPHA_MIN, ALPHA_MAX = 1.0 / 255.0, 0.999


def matrix_of(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


class Ray:
    """The Gaussians on the ray of one pixel."""

    def __init__(self, gaussians: Gaussians, splats: Projected, camera: Camera, x: int, y: int) -> None:
        """``splats``: the reference's projection of the same Gaussians."""
        K, view = camera.K.double().numpy(), camera.viewmat.double().numpy()
        ray = np.array([(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], 1.0])
        self.sharpness = gaussians.sharpness
        rows = []
        for i in range(len(gaussians.means)):
            if splats.radii[i, 0] == 0:
                continue
            a, b, c = splats.conics[i].tolist()
            dx, dy = (np.array([x + 0.5, y + 0.5]) - splats.means2d[i].numpy()).tolist()
            q = a * dx * dx + 2 * b * dx * dy + c * dy * dy
            opacity = float(splats.opacities[i])
            if self.alpha(opacity, q) < ALPHA_MIN:
                continue
            axes = view[:3, :3] @ matrix_of(gaussians.quats[i].double().numpy())
            precision = axes @ np.diag(gaussians.scales[i].double().numpy() ** -2.0) @ axes.T
            point = view[:3, :3] @ gaussians.means[i].double().numpy() + view[:3, 3]
            squared = ray @ precision @ ray
            rows.append((ray @ precision @ point / squared, squared**-0.5, q, opacity))
        self.rows = np.array(rows).reshape(-1, 4)

    def alpha(self, opacity, q):
        u = 0.5 * q
        return np.minimum(ALPHA_MAX, opacity * np.exp(-u * (1.0 + self.sharpness * u)))

    def opacity_until(self, depth: float) -> float:
        """The opacity accumulated from the camera to a depth."""
        peaks, deviations, q, opacities = self.rows.T
        before = np.minimum((depth - peaks) / deviations, 0.0)
        return 1.0 - float(np.prod(1.0 - self.alpha(opacities, q + before**2)))

    def depth(self, level: float) -> float:
        """The least depth at which the opacity reaches the level; 0 where it never does."""
        if not len(self.rows) or self.opacity_until(np.inf) < level:
            return 0.0
        low, high = 0.0, float(self.rows[:, 0].max())
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (low, middle) if self.opacity_until(middle) >= level else (middle, high)
        return high
