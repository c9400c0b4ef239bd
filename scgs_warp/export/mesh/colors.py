"""Colours of a mesh's vertices: the mean of what cameras around it see of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_matrix, csr_matrix

from ...types import Camera, Gaussians
from .views import Sight, Surroundings, cameras_around, sight_of

VIEWS = 32
"""Number of images that give colours."""
SIZE = 640
"""Longer side of these images in pixels."""
DEPTH_TOLERANCE = 0.01
"""Largest difference of a visible vertex's depth from that of the image, relative to the radius of the mesh."""
LEAST_ALPHA = 0.9
"""Alpha from which a pixel shows the surface alone."""
SLANT_POWER = 3.0
"""Power of the cosine with which a view counts: views from ahead are sharp, slanted ones show highlights."""
TRAINED_BAND = 40.0
"""Largest difference in elevation from the training cameras, in degrees, at which colours have been trained."""
BEYOND_BAND = 0.01
"""Weight of views beyond, which give the colours of what no other view sees."""


class PosedMesh(NamedTuple):
    """A mesh and the Gaussians that it stands for, at one moment, in normalised units."""

    vertices: np.ndarray
    """[V, 3]"""
    gaussians: Gaussians


def paint(
    surroundings: Surroundings,
    moments: Sequence[Callable[[], PosedMesh]],
    faces: np.ndarray,
    advance: Callable[[], None] | None = None,
) -> np.ndarray:
    """Return the colour of each vertex, [V, 3] sRGB in [0, 1]. Vertices that no view sees take those around them.

    Args:
        moments: makers of the mesh at the moments over which colours are averaged; ``VIEWS`` views in all, one by one
            from each moment.
        faces: [F, 3]
        advance: called after each view.
    """
    total = weight = np.zeros(0)
    for number, make in enumerate(moments):
        vertices, gaussians = make()
        if not number:
            total, weight = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        radius = max(float(np.linalg.norm(high - low)) / 2.0, 1e-6)
        cameras = cameras_around(surroundings, (low + high) / 2.0, radius, VIEWS, SIZE)
        normals = vertex_normals(vertices, faces)
        for camera in cameras[number :: len(moments)]:
            sight = sight_of(surroundings, gaussians, camera)
            seen, share, rgb = _seen_colors(vertices, normals, camera, sight, DEPTH_TOLERANCE * radius)
            share *= _trust(surroundings, camera)
            total[seen] += share[:, None] * rgb
            weight[seen] += share
            if advance is not None:
                advance()
    return _filled(total, weight, faces).clip(0.0, 1.0)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit normals [V, 3], means over the faces by area; +z where there is none."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    ones = np.ones(faces.size)
    around = csr_matrix((ones, (faces.ravel(), np.repeat(np.arange(len(faces)), 3))), (len(vertices), len(faces)))
    normals = around @ np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 1e-300, normals / np.maximum(length, 1e-300), (0.0, 0.0, 1.0))


def _trust(surroundings: Surroundings, camera: Camera) -> float:
    """Return the weight of a view by its elevation, since colours were trained from those of the training cameras."""
    up = np.array(surroundings.overview.up)
    ahead = camera.viewmat[2, :3].double().numpy()
    elevation = float(np.degrees(np.arcsin(np.clip(-ahead @ up, -1.0, 1.0))))
    return 1.0 if abs(elevation - surroundings.overview.elevation) <= TRAINED_BAND else BEYOND_BAND


def _seen_colors(
    vertices: np.ndarray, normals: np.ndarray, camera: Camera, sight: Sight, tolerance: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the vertices that a view sees [S], their weights [S], and their colours [S, 3]."""
    viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    local = vertices @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = np.maximum(local[:, 2], 1e-9)
    x, y = (K[axis, axis] * local[:, axis] / z + K[axis, 2] - 0.5 for axis in (0, 1))
    facing = -np.einsum("ij,ij->i", normals @ viewmat[:3, :3].T, local) / np.linalg.norm(local, axis=1)
    depth, alpha = sight.depth.cpu().numpy(), sight.alpha.cpu().numpy()
    inside = (x > 0) & (y > 0) & (x < depth.shape[1] - 1) & (y < depth.shape[0] - 1)
    seen = np.flatnonzero(inside & (facing > 0.05) & (local[:, 2] > 0))
    column, row = np.rint(x[seen]).astype(int), np.rint(y[seen]).astype(int)
    near = (np.abs(depth[row, column] - z[seen]) < tolerance) & (alpha[row, column] > LEAST_ALPHA)
    seen = seen[near]
    where = np.stack([y[seen], x[seen]])
    planes = sight.rgb.cpu().double().numpy()
    rgb = np.stack([map_coordinates(planes[..., channel], where, order=1) for channel in range(3)], axis=1)
    return seen, facing[seen] ** SLANT_POWER, rgb


def _filled(total: np.ndarray, weight: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return total over weight; where the weight is 0, colours spread from the neighbours, ring by ring."""
    count = len(weight)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    adjacent = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count)).tocsr()
    adjacent = adjacent + adjacent.T
    known = weight > 0
    colors = np.where(known[:, None], total / np.maximum(weight, 1e-300)[:, None], 0.5)
    while not known.all():
        share = adjacent @ known.astype(np.float64)
        reached = ~known & (share > 0)
        if not reached.any():
            colors[~known] = colors[known].mean(axis=0) if known.any() else 0.5
            break
        colors[reached] = (adjacent @ np.where(known[:, None], colors, 0.0))[reached] / share[reached, None]
        known = known | reached
    return colors
