"""Similarity transforms: x -> scale R x + t. Structure from motion knows a scene up to one of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..geometry.cameras import agreed_up

MEDIAN_DISTANCE = 4.0
"""From the middle of the scene to the cameras, in units of the written scene: about D-NeRF's."""


class Similarity(NamedTuple):
    scale: float
    rotation: np.ndarray
    """[3, 3]"""
    translation: np.ndarray
    """[3]"""

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points [..., 3], moved."""
        return self.scale * points @ self.rotation.T + self.translation

    def viewmats(self, viewmats: np.ndarray) -> np.ndarray:
        """World-to-camera [V, 4, 4] in the new world, rigid again: the cameras see what they saw, ``scale`` larger."""
        moved = viewmats.copy()
        moved[:, :3, :3] = viewmats[:, :3, :3] @ self.rotation.T
        moved[:, :3, 3] = self.scale * viewmats[:, :3, 3] - moved[:, :3, :3] @ self.translation
        return moved


def centres(viewmats: np.ndarray) -> np.ndarray:
    """[V, 3] of the cameras."""
    return -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])


def align(points: np.ndarray, targets: np.ndarray) -> Similarity:
    """The similarity that brings points [N, 3] closest to targets [N, 3] in the least-squares sense.

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
    """Puts the middle of the points at the origin, what the cameras call up along +z and their mean direction along
    +y, and the cameras ``MEDIAN_DISTANCE`` away at the median."""
    up, ahead = agreed_up(viewmats[:, :3, :3]), viewmats[:, 2, :3].mean(0)
    ahead = ahead - up * (up @ ahead)
    if np.linalg.norm(ahead) < 1e-6:  # cameras all around, or looking along their up: any direction will do
        ahead = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    ahead /= np.linalg.norm(ahead)
    rotation = np.stack([np.cross(ahead, up), ahead, up])
    positions = centres(viewmats)
    middle = np.median(points, axis=0) if len(points) else positions.mean(0)
    distance = float(np.median(np.linalg.norm(positions - middle, axis=1)))
    scale = MEDIAN_DISTANCE / distance if distance > 0 else 1.0
    return Similarity(scale, rotation, -scale * rotation @ middle)
