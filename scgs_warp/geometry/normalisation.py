"""Scene normalisation: a shift and a scale, in float64, that fit the content roughly into a ball of radius 1.37."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..types import Camera
from .cameras import nearest_to_axes, places_and_directions, point_ahead, rounding

COMMON_RADIUS = 1.3654
"""Radius, after normalisation, of the region that all cameras see, or of the bulk of the initial points. It is chosen
so that D-NeRF's rig (cameras at 4.031, field of view 0.6911, figures in [-1.3, 1.3]^3) is left unchanged."""
BULK = 0.95
"""Fraction of the initial points placed within COMMON_RADIUS; the rest may be far background."""
FEWEST_POINTS = 10
"""Smallest number of initial points from which the scene is located; with fewer points the cameras are used."""


@dataclass(frozen=True)
class Normalisation:
    """The map ``normalised = (world - centre) * scale``."""

    centre: np.ndarray
    """[3] float64, world units."""
    scale: float
    """Number of normalised units per world unit, > 0."""

    @staticmethod
    def identity() -> Normalisation:
        return Normalisation(np.zeros(3), 1.0)

    @staticmethod
    def fit(cameras: Sequence[Camera], points: Tensor | None = None, distance: float | None = None) -> Normalisation:
        """Fit centre and scale to ten or more initial points (median; 95 % within the radius), or else to the cameras.

        From cameras, the centre is the point nearest to all optical axes, and the radius is that of the largest sphere
        around the centre that fits into the median camera's view.

        Args:
            cameras: at least one.
            points: [P, 3] world.
            distance: without points, where the optical axes do not meet: the distance of the scene before the mean
                camera, if it is known.

        Raises:
            ValueError: ``cameras`` is empty.
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
        centre = _centre(positions, axes, distance)
        radius = float(np.median(np.linalg.norm(positions - centre, axis=1) * sines))
        return Normalisation(centre, COMMON_RADIUS / radius if radius > 0 else 1.0)

    def apply(self, points: Tensor) -> Tensor:
        """Convert points [..., 3] from world to normalised units, in float64; the result has the points' dtype."""
        centre = _on_device(tuple(self.centre), points.device)
        return ((points.double() - centre) * self.scale).to(points.dtype)

    def undo(self, points: Tensor) -> Tensor:
        """Convert points [..., 3] from normalised to world units."""
        centre = _on_device(tuple(self.centre), points.device)
        return (points.double() / self.scale + centre).to(points.dtype)

    def undo_scale(self, lengths: Tensor) -> Tensor:
        """Convert lengths (depths, standard deviations) from normalised to world units."""
        return (lengths.double() / self.scale).to(lengths.dtype)

    def apply_camera(self, camera: Camera) -> Camera:
        """Return the camera that sees the normalised scene at the same pixels, with depths multiplied by ``scale``."""
        shift, factors = _change_of_cameras(tuple(self.centre), self.scale, camera.viewmat.device)
        moved = (camera.viewmat.double() @ shift) * factors
        return Camera(moved.to(camera.viewmat.dtype), camera.K, camera.width, camera.height)

    def undo_camera(self, camera: Camera) -> Camera:
        """Invert :meth:`apply_camera`: return the camera in world units."""
        viewmat = camera.viewmat.double()
        centre = _on_device(tuple(self.centre), viewmat.device)
        moved = viewmat.clone()
        moved[:3, 3] = viewmat[:3, 3] / self.scale - viewmat[:3, :3] @ centre
        return Camera(moved.to(camera.viewmat.dtype), camera.K, camera.width, camera.height)


@functools.lru_cache(maxsize=64)
def _on_device(centre: tuple[float, ...], device: torch.device) -> Tensor:
    """Return the centre, [3] float64. It is kept, because sending it makes the host wait for a GPU."""
    with torch.inference_mode(False):
        return torch.tensor(centre, dtype=torch.float64, device=device)


@functools.lru_cache(maxsize=64)
def _change_of_cameras(centre: tuple[float, ...], scale: float, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return two [4, 4] float64: the translation to the centre, and the factors by which translations grow."""
    with torch.inference_mode(False):
        shift, factors = torch.eye(4, dtype=torch.float64), torch.ones(4, 4, dtype=torch.float64)
        shift[:3, 3], factors[:3, 3] = torch.tensor(centre, dtype=torch.float64), scale
        return shift.to(device), factors.to(device)


def _rig(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return camera centres [V, 3], viewing directions [V, 3], and sines [V] of half the narrower field of view."""
    positions, axes = places_and_directions(cameras)
    Ks = torch.stack([camera.K for camera in cameras]).double().cpu().numpy()
    sizes = np.array([(camera.width, camera.height) for camera in cameras], np.float64)
    half = (0.5 * sizes / Ks[:, [0, 1], [0, 1]]).min(axis=1)
    return positions, axes, half / np.sqrt(1.0 + half * half)


def _centre(positions: np.ndarray, axes: np.ndarray, distance: float | None) -> np.ndarray:
    """Return the point nearest to all optical axes. If a distance is given, or the axes are parallel or meet behind the
    cameras, it lies ahead of them."""
    centre = nearest_to_axes(positions, axes) if distance is None else None
    if centre is not None and np.median(np.einsum("vi,vi->v", centre - positions, axes)) > rounding(positions):
        return centre
    return point_ahead(positions, axes, distance)
