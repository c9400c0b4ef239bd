"""Similarity transforms x -> scale R x + t. Structure from motion determines a scene only up to such a transform."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..geometry.cameras import agreed_up

MEDIAN_DISTANCE = 4.0
"""Median distance of the cameras from the centre of the written scene, similar to D-NeRF's."""


class Similarity(NamedTuple):
    scale: float
    rotation: np.ndarray
    """[3, 3]"""
    translation: np.ndarray
    """[3]"""

    def points(self, points: np.ndarray) -> np.ndarray:
        """Transform points [..., 3]."""
        return self.scale * points @ self.rotation.T + self.translation

    def viewmats(self, viewmats: np.ndarray) -> np.ndarray:
        """Transform world-to-camera matrices [V, 4, 4] to the new world; the cameras stay rigid and see the scaled
        scene."""
        moved = viewmats.copy()
        moved[:, :3, :3] = viewmats[:, :3, :3] @ self.rotation.T
        moved[:, :3, 3] = self.scale * viewmats[:, :3, 3] - moved[:, :3, :3] @ self.translation
        return moved


def centres(viewmats: np.ndarray) -> np.ndarray:
    """Return the camera centres [V, 3]."""
    return -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])


def align(points: np.ndarray, targets: np.ndarray) -> Similarity:
    """Fit the similarity that maps points [N, 3] to targets [N, 3] in the least-squares sense.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991, eq. 40-42.
    """
    middle, goal = points.mean(0), targets.mean(0)
    from_middle, from_goal = points - middle, targets - goal
    u, singular, vt = np.linalg.svd(from_goal.T @ from_middle / len(points))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt)) or 1.0])
    rotation = (u * signs) @ vt
    spread = np.square(from_middle).sum(1).mean()
    scale = float((singular * signs).sum() / spread) if spread > 0 else 1.0
    return Similarity(scale, rotation, goal - scale * rotation @ middle)


def upright(viewmats: np.ndarray, points: np.ndarray) -> Similarity:
    """Return the similarity that moves the points' median to the origin, turns the cameras' common up direction to +z
    and their mean viewing direction to +y, and scales the cameras' median distance from the origin to
    ``MEDIAN_DISTANCE``."""
    up, ahead = agreed_up(viewmats[:, :3, :3]), viewmats[:, 2, :3].mean(0)
    ahead = ahead - up * (up @ ahead)
    if np.linalg.norm(ahead) < 1e-6:  # Cameras all around have no mean direction: any horizontal one will do.
        ahead = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    ahead /= np.linalg.norm(ahead)
    rotation = np.stack([np.cross(ahead, up), ahead, up])
    positions = centres(viewmats)
    middle = np.median(points, axis=0) if len(points) else positions.mean(0)
    distance = float(np.median(np.linalg.norm(positions - middle, axis=1)))
    scale = MEDIAN_DISTANCE / distance if distance > 0 else 1.0
    return Similarity(scale, rotation, -scale * rotation @ middle)
