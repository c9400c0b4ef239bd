"""Cleaning of surfaces: islands, cavities, noise."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from .surface import Surface

ISLAND_SIDE = 0.02
"""Extent below which a part of the surface is left out, relative to the extent of the largest part."""
SHARED_AREA = 1e-3
"""Area below which a part of the surface is left out, relative to the area of all."""
SMOOTHING = 10
"""Number of rounds of smoothing."""
SHRINK, SWELL = 0.5, -0.53
"""Steps of Taubin's smoothing (1995), which removes noise and keeps the volume."""


def clean(surface: Surface, closed: bool) -> Surface:
    """Remove islands, cavities and noise."""
    kept = without_islands(surface, closed)
    return smooth(kept) if len(kept.faces) else kept


def without_islands(surface: Surface, closed: bool) -> Surface:
    """Leave out the parts that are tiny beside the rest, and with ``closed`` those that bound a cavity, which nobody
    sees; drop unused vertices."""
    vertices, faces = compact(surface)
    if not len(faces):
        return Surface(vertices, faces)
    count, part = _parts(len(vertices), faces)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    part = part[faces[:, 0]]
    area = np.bincount(part, np.linalg.norm(normals, axis=1), count)
    volume = np.bincount(part, np.einsum("ij,ij->i", normals, a), count)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, part, a)
    np.maximum.at(high, part, a)
    side = np.linalg.norm(high - low, axis=1)
    keep = (side >= ISLAND_SIDE * side.max()) & (area >= SHARED_AREA * area.sum())
    if closed:
        keep &= volume > 0
    keep[area.argmax()] = True
    return compact(Surface(vertices, faces[keep[part]]))


def compact(surface: Surface) -> Surface:
    """Drop vertices that no face uses."""
    used, faces = np.unique(surface.faces, return_inverse=True)
    return Surface(surface.vertices[used], faces.reshape(-1, 3).astype(np.int32))


def smooth(surface: Surface, rounds: int = SMOOTHING) -> Surface:
    """Smooth a surface; vertices on open borders stay."""
    vertices, faces = surface
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    shape = (len(vertices), len(vertices))
    adjacent = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=shape).tocsr()
    both = adjacent + adjacent.T
    rows, columns = both.nonzero()
    free = np.ones(len(vertices))
    free[rows[np.asarray(both[rows, columns]).ravel() == 1.0]] = 0.0  # ends of edges with one face
    both.data[:] = 1.0
    degree = np.maximum(np.asarray(both.sum(axis=1)).ravel(), 1.0)
    moved = vertices
    for _ in range(rounds):
        for step in (SHRINK, SWELL):
            moved = moved + step * free[:, None] * (both @ moved / degree[:, None] - moved)
    return Surface(moved, faces)


def _parts(count: int, faces: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of connected parts and the part of each vertex."""
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    matrix = coo_matrix((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(count, count))
    parts, labels = connected_components(matrix, directed=False)
    return int(parts), labels
