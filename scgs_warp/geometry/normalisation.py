"""Scene normalisation: one shift and one scale, in float64, that bring the content near the ball of radius 1.37."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..types import Camera
from .cameras import rounding

COMMON_RADIUS = 1.3654
"""Radius, after normalisation, of what all cameras see (or of the initial points' bulk). It is that of D-NeRF's rig
(cameras at 4.031, field of view 0.6911), whose frame therefore stays as it is, its figures within [-1.3, 1.3]^3."""
BULK = 0.95
"""Fraction of the initial points that shall lie within COMMON_RADIUS; the rest may be far background."""
FEWEST_POINTS = 10
"""Fewer say nothing of where the scene is."""
PARALLEL = 1e-4
"""Smallest eigenvalue of the mean of (I - d d^T) at which optical axes still define a nearest point: some 1 degree."""


@dataclass(frozen=True)
class Normalisation:
    """``normalised = (world - centre) * scale``."""

    centre: np.ndarray
    """[3] float64, world units."""
    scale: float
    """Normalised units per world unit, > 0."""

    @staticmethod
    def identity() -> Normalisation:
        return Normalisation(np.zeros(3), 1.0)

    @staticmethod
    def fit(cameras: Sequence[Camera], points: Tensor | None = None) -> Normalisation:
        """From initial points where there are at least ten (median; 95 % within the radius), else from the cameras:
        the point nearest to all optical axes, and the sphere about it that the median camera sees whole.

        Args:
            cameras: at least one.
            points: [P, 3] world.
        """
        if not cameras:
            raise ValueError("cameras: at least one is needed")
        if points is not None:
            cloud = points.detach().cpu().double().numpy()
            cloud = cloud[np.isfinite(cloud).all(axis=1)]
            if len(cloud) >= FEWEST_POINTS:
                centre = np.median(cloud, axis=0)
                radius = float(np.quantile(np.linalg.norm(cloud - centre, axis=1), BULK))
                if radius > 0:
                    return Normalisation(centre, COMMON_RADIUS / radius)
        positions, axes, sines = _rig(cameras)
        centre = _nearest_to_axes(positions, axes)
        radius = float(np.median(np.linalg.norm(positions - centre, axis=1) * sines))
        return Normalisation(centre, COMMON_RADIUS / radius if radius > 0 else 1.0)

    def apply(self, points: Tensor) -> Tensor:
        """[..., 3] world to normalised, in the points' dtype (the arithmetic is float64)."""
        centre = torch.as_tensor(self.centre, device=points.device)
        return ((points.double() - centre) * self.scale).to(points.dtype)

    def undo(self, points: Tensor) -> Tensor:
        """[..., 3] normalised to world."""
        centre = torch.as_tensor(self.centre, device=points.device)
        return (points.double() / self.scale + centre).to(points.dtype)

    def undo_scale(self, lengths: Tensor) -> Tensor:
        """Lengths (depths, standard deviations) from normalised to world units."""
        return (lengths.double() / self.scale).to(lengths.dtype)

    def apply_camera(self, camera: Camera) -> Camera:
        """The camera that sees the normalised scene at the same pixels, depths times ``scale``."""
        viewmat = camera.viewmat.double()
        centre = torch.as_tensor(self.centre, device=viewmat.device)
        moved = viewmat.clone()
        moved[:3, 3] = (viewmat[:3, 3] + viewmat[:3, :3] @ centre) * self.scale
        return Camera(moved.to(camera.viewmat.dtype), camera.K, camera.width, camera.height)

    def undo_camera(self, camera: Camera) -> Camera:
        """Inverse of :meth:`apply_camera`."""
        viewmat = camera.viewmat.double()
        centre = torch.as_tensor(self.centre, device=viewmat.device)
        moved = viewmat.clone()
        moved[:3, 3] = viewmat[:3, 3] / self.scale - viewmat[:3, :3] @ centre
        return Camera(moved.to(camera.viewmat.dtype), camera.K, camera.width, camera.height)


def _rig(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Camera centres [V, 3], viewing directions [V, 3], and sines [V] of half the narrower field of view."""
    viewmats = torch.stack([camera.viewmat for camera in cameras]).double().cpu().numpy()
    Ks = torch.stack([camera.K for camera in cameras]).double().cpu().numpy()
    sizes = np.array([(camera.width, camera.height) for camera in cameras], np.float64)
    positions = -np.einsum("vij,vi->vj", viewmats[:, :3, :3], viewmats[:, :3, 3])
    axes = viewmats[:, 2, :3] / np.linalg.norm(viewmats[:, 2, :3], axis=1, keepdims=True)
    half = (0.5 * sizes / Ks[:, [0, 1], [0, 1]]).min(axis=1)
    return positions, axes, half / np.sqrt(1.0 + half * half)


def _nearest_to_axes(positions: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Least squares: sum over cameras of (I - d d^T)(x - p) = 0. Near-parallel axes leave x open along them; then
    it is put ahead of the cameras by twice the rig's size."""
    projectors = np.eye(3) - np.einsum("vi,vj->vij", axes, axes)
    A, least = projectors.mean(axis=0), rounding(positions)
    if np.linalg.eigvalsh(A)[0] > PARALLEL:
        centre = np.linalg.solve(A, np.einsum("vij,vj->i", projectors, positions) / len(positions))
        if np.median(np.einsum("vi,vi->v", centre - positions, axes)) > least:
            return centre
    middle = positions.mean(axis=0)
    spread = float(np.linalg.norm(positions - middle, axis=1).max())
    return middle + axes.mean(axis=0) * (2.0 * spread if spread > least else 1.0)
