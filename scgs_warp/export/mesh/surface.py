"""The surface of posed Gaussians as a triangle mesh: depth images from all around, fused into a volume, and its zero
level by marching cubes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from ...errors import UserError
from ...ops.fusion import Volume, grid_shape
from ...runtime import memory
from ...runtime.cuda_graph import on_torch_stream
from ...runtime.launch import warp_view
from ...types import Gaussians
from ..no_surface import NoSurface
from .views import Surroundings, cameras_around, depth_of, points_of

RESOLUTION = 256
"""Number of voxels along the longest side of the subject."""
TRUNCATION = 4.0
"""Truncation of the distances in voxels: twice the largest error of the depth images leaves no holes."""
VIEWS = 48
"""Number of depth images that are fused."""
PIXELS_PER_VOXEL = 1.75
"""Longer side of the depth images, relative to the resolution."""
FIRST_VIEWS, FIRST_SIZE = 24, 192
"""Number and size of the images that locate the surface."""
STRAY_SHARE = 2e-4
"""Share of the located points on each side of an axis that may be strays."""
MARGIN = 0.03
"""Free space around the subject, relative to its longest side."""
OPAQUE = 0.5
REACH = 0.8
"""Radius of the region of a scene with surroundings, relative to the distance of the cameras from its centre."""
ON_PLANE = 1e-4
"""Distance in voxels from a plane of the grid below which a vertex is on it."""
MAX_VOXELS = 2**31 - 2**16
"""Kernels count in 32 bits with a sign; a launch rounds up to whole blocks."""
BYTES_PER_VOXEL = 24
"""Bytes that the sums, the weights, the distances and marching cubes' indices take."""


class Surface(NamedTuple):
    """A triangle mesh."""

    vertices: np.ndarray
    """[V, 3] float64"""
    faces: np.ndarray
    """[F, 3] int32, counter-clockwise from outside."""


class Region(NamedTuple):
    """A box with a subject, in normalised units."""

    lower: np.ndarray
    """[3] float64"""
    upper: np.ndarray
    """[3]"""

    @property
    def centre(self) -> np.ndarray:
        """Centre of the box, [3]."""
        return (self.lower + self.upper) / 2.0

    @property
    def radius(self) -> float:
        """Radius of the ball around the box."""
        return float(np.linalg.norm(self.upper - self.lower)) / 2.0

    @property
    def side(self) -> float:
        """Longest side."""
        return float((self.upper - self.lower).max())


def locate(surroundings: Surroundings, gaussians: Gaussians) -> Region:
    """Find the box that holds the visible surface. Strays are left out.

    Args:
        gaussians: posed, in normalised units.

    Raises:
        NoSurface: nothing is opaque.
    """
    overview = surroundings.overview
    opaque = gaussians.means[gaussians.opacities > OPAQUE].cpu().double().numpy()
    if not len(opaque):
        raise NoSurface(f"no Gaussian is opaque to more than {OPAQUE:g}, so that there is no surface")
    if surroundings.closed:
        low, high = np.quantile(opaque, (STRAY_SHARE, 1.0 - STRAY_SHARE), axis=0)
        centre, radius = (low + high) / 2.0, max(float(np.linalg.norm(high - low)) / 2.0, 1e-6)
        radius = min(1.2 * radius, max(overview.radius, radius))
    else:
        centre, radius = np.array(overview.centre), overview.radius
    cameras = cameras_around(surroundings, centre, radius, FIRST_VIEWS, FIRST_SIZE)
    points = np.concatenate([points_of(depth_of(surroundings, gaussians, camera), camera) for camera in cameras])
    if not surroundings.closed:
        points = points[np.linalg.norm(points - centre, axis=1) < REACH * radius]
    if not len(points):
        raise NoSurface("no surface was found")
    low, high = np.quantile(points, (STRAY_SHARE, 1.0 - STRAY_SHARE), axis=0)
    margin = max(MARGIN * float((high - low).max()), 1e-6)
    return Region(low - margin, high + margin)


def reconstruct(
    surroundings: Surroundings,
    gaussians: Gaussians,
    region: Region,
    resolution: int = RESOLUTION,
    advance: Callable[[], None] | None = None,
) -> Surface:
    """Extract the surface of posed Gaussians, in normalised units.

    A closed subject has a closed surface: what no view sees is taken for its inside. Of a scene with surroundings, only
    the surface that was seen is kept.

    Args:
        gaussians: posed, in normalised units.
        resolution: number of voxels along the longest side of the region.
        advance: called after each of the ``VIEWS`` views.

    Raises:
        NotEnoughMemory: the volume does not fit into memory.
        NoSurface: there is no surface.
        UserError: the volume has too many voxels.
    """
    voxel = region.side / resolution
    count = int(np.prod(grid_shape(region.lower, region.upper, voxel), dtype=np.int64))
    what = f"a volume of {count:,} voxels"
    if count > MAX_VOXELS:
        raise UserError(f"{what} is more than the {MAX_VOXELS:,} that kernels can index; give a smaller --resolution")
    memory.require(BYTES_PER_VOXEL * count, gaussians.means.device, what, "give a smaller --resolution")
    volume = Volume.empty(region.lower, region.upper, voxel, TRUNCATION * voxel, gaussians.means.device)
    size = 2 * round(PIXELS_PER_VOXEL * resolution / 2)
    for camera in cameras_around(surroundings, region.centre, region.radius, VIEWS, size):
        volume.add(depth_of(surroundings, gaussians, camera), camera)
        if advance is not None:
            advance()
    surface = zero_level(volume, surroundings.closed)
    if not len(surface.faces):
        raise NoSurface("no surface was found")
    return surface


def zero_level(volume: Volume, closed: bool) -> Surface:
    """Extract the surface where the distance is zero, by marching cubes.

    Args:
        closed: whether the surface is to be closed: unseen voxels are inside, those at the border of the volume
            outside. Otherwise, triangles beside unseen voxels are left out.
    """
    from warp.geometry import IsoSurfaceMarchingCubes

    field = volume.distances()
    if closed:
        for axis in range(3):
            field.select(axis, 0).clamp_(min=1e-3)
            field.select(axis, field.shape[axis] - 1).clamp_(min=1e-3)
    if not bool((field < 0).any() & (field > 0).any()):
        return Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    values: Any = warp_view(field.contiguous(), wp.float32)
    with on_torch_stream(field.device) if field.is_cuda else nullcontext():
        places, indices = IsoSurfaceMarchingCubes.extract(values, 0.0)
    cells = places.numpy().astype(np.float64)
    faces = indices.numpy().reshape(-1, 3).astype(np.int32)
    if not closed:
        known = (volume.weights > 0).cpu().numpy()
        last = np.array(known.shape) - 1  # rounding moves vertices off the grid's planes, at its border out of the grid
        low = np.clip(np.floor(cells + ON_PLANE), 0, last).astype(int)
        high = np.clip(np.ceil(cells - ON_PLANE), 0, last).astype(int)
        seen = known[tuple(low.T)] & known[tuple(high.T)]
        faces = faces[seen[faces].all(axis=1)]
    return Surface(volume.lower + volume.voxel * cells, faces)
