"""Fusion of depth images into a volume of signed distances."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
import warp as wp
from torch import Tensor

from ..kernels import fusion as kernels
from ..runtime.launch import launch
from ..types import Camera

LEAST_COSINE = 0.1
"""Smallest weight of a view: surfaces that are seen edge-on still say where nothing is."""


@dataclass(frozen=True)
class Volume:
    """Signed distances on a regular grid, as weighted sums over views."""

    lower: np.ndarray
    """[3] float64, position of the first voxel."""
    voxel: float
    """Distance of neighbouring voxels."""
    truncation: float
    """Distance from the surface up to which a view says something about what is behind it."""
    sums: Tensor
    """[X, Y, Z] weights times distances in units of the truncation, which are in [-1, 1], positive outside."""
    weights: Tensor
    """[X, Y, Z] 0 where no view said anything."""

    @staticmethod
    def empty(
        lower: np.ndarray, upper: np.ndarray, voxel: float, truncation: float, device: torch.device | str = "cpu"
    ) -> Volume:
        """Return a volume that covers the box from ``lower`` to ``upper`` [3]."""
        shape = grid_shape(lower, upper, voxel)
        lower = np.asarray(lower, np.float64)
        return Volume(lower, voxel, truncation, torch.zeros(shape, device=device), torch.zeros(shape, device=device))

    def add(self, depth: Tensor, camera: Camera) -> None:
        """Add what a view sees.

        Args:
            depth: [H, W] camera z of the surface, in the units of the volume; 0 where the ray meets no surface, which
                carves the volume.
            camera: of the same size, in the frame of the volume.

        Raises:
            ValueError: the sizes differ, or are less than 2.
        """
        if tuple(depth.shape) != (camera.height, camera.width) or min(depth.shape) < 2:
            raise ValueError(f"depth must be {camera.height} x {camera.width} (at least 2), got {list(depth.shape)}")
        depth, cosine = depth.detach().contiguous(), torch.empty_like(depth)
        view, K = (part[None].float().contiguous().to(depth.device) for part in (camera.viewmat, camera.K))
        launch(kernels.cosines, depth.numel(), depth, K, self.truncation, cosine)
        outline = _distance_to_surface(depth)
        _, ny, nz = self.sums.shape
        lower = wp.vec3(*self.lower.tolist())
        launch(
            kernels.fuse, self.sums.numel(), depth, cosine, outline, view, K, lower, self.voxel, ny, nz,
            self.truncation, LEAST_COSINE, self.sums.view(-1), self.weights.view(-1), grain=4096,
        )  # fmt: skip

    def distances(self, unknown: float = -1.0) -> Tensor:
        """Return [X, Y, Z] distances in units of the truncation; ``unknown`` where no view said anything."""
        return torch.where(self.weights > 0, self.sums / self.weights.clamp_min(1e-12), unknown)


def _distance_to_surface(depth: Tensor) -> Tensor:
    """Return the distance of each pixel [H, W] from the nearest one that shows a surface, in pixels."""
    missing = (depth == 0).to(torch.uint8).cpu().numpy()
    distance = cv2.distanceTransform(missing, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return torch.from_numpy(distance).to(depth.device)


def grid_shape(lower: np.ndarray, upper: np.ndarray, voxel: float) -> tuple[int, int, int]:
    """Return the number of voxels along each axis of a volume that covers the box from ``lower`` to ``upper``."""
    x, y, z = (max(int(np.ceil(side / voxel)) + 1, 2) for side in np.subtract(upper, lower))
    return x, y, z
