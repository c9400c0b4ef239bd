"""Binding of a mesh to the control points: each vertex takes the weights of the Gaussians around it.

The mesh is the surface at one moment. A vertex x of it is at ``sum_k w_k J_k(t) J_k(t0)^-1 x`` at time t, where J_k is
the rigid transform of control point k: linear blend skinning, whose bind pose is the moment of the mesh.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.spatial.distance import cdist

from ...edit.rotations import conjugate, multiply, rotate
from ...runtime.search_tree import search_tree
from ..skeleton import Skeleton
from .surface import Surface

NEIGHBORS = 12
"""Number of Gaussians whose weights a vertex blends."""
INFLUENCES = 4
"""Number of control points that move a vertex: what every player of glTF supports."""
SAMPLES = 12
"""Number of frames at which motions are compared."""
CONTACT = 1.5
"""Distance below which two control points count as near, in median distances of nearest control points."""
APART = 2.5
"""Factor by which the distance of near control points grows if they belong to different parts."""
FEW_SHARE = 0.1
"""Position between the smallest and the largest number of contacts up to which a frame has few."""
SMOOTHING = 8
"""Number of rounds in which vertices take half of their neighbours' mean weights."""
CHUNK = 4096
"""Number of vertices whose weights of all control points are in memory."""
LOOSENESS = 0.25
"""Change of the distance to the nearest Gaussian, relative to the reach of the neighbours, at which another Gaussian
counts by 1 / e."""


def clearest_frame(skeleton: Skeleton) -> int:
    """Return the frame whose surface suits all times.

    Few of its control points are near others from which they move away at other times, so that the surface joins few
    parts that do not belong together. Of such frames, it is the one with the least mean squared distance from all
    others, so that no part is bent far.
    """
    positions = skeleton.positions
    frames = sample_frames(len(positions), 4 * SAMPLES)
    tree = search_tree(positions[0])
    if positions.shape[1] < 2 or len(frames) < 2:
        return 0
    near = CONTACT * float(np.median(tree.query(positions[0], 2)[0][:, 1]))
    farthest = np.zeros((positions.shape[1],) * 2)
    for frame in frames:
        farthest = np.maximum(farthest, _distances(positions[frame]))
    strangers = farthest > APART * near
    counts = np.array([(strangers & (_distances(positions[frame]) < near)).sum() for frame in frames])
    spread = np.array([((positions[frames] - positions[frame]) ** 2).sum(axis=2).mean() for frame in frames])
    few = counts <= counts.min() + FEW_SHARE * (counts.max() - counts.min())
    return int(frames[int(np.where(few, spread, np.inf).argmin())])


def sample_frames(count: int, most: int) -> np.ndarray:
    """Return at most ``most`` frames of ``count``, evenly spread, with the first and the last."""
    return np.unique(np.rint(np.linspace(0, count - 1, min(count, most))).astype(int))


def bind(surface: Surface, tracks: np.ndarray, skeleton: Skeleton) -> Skeleton:
    """Bind a mesh to the control points.

    Args:
        surface: the mesh at one frame of the skeleton, world units.
        tracks: [S, N, 3] positions of the skeleton's Gaussians, first at this frame, then at other times.
        skeleton: with the binding of N Gaussians.

    Returns:
        The skeleton with the binding of the vertices; each has at most ``INFLUENCES`` joints.
    """
    vertices, count = surface.vertices, min(NEIGHBORS, tracks.shape[1])
    distance, around = search_tree(tracks[0]).query(vertices, count)
    distance, around = distance.reshape(-1, count), around.reshape(-1, count)
    reach = np.maximum(distance[:, -1:], 1e-12)
    share = np.exp(-((2.0 * distance / reach) ** 2))
    stretch = np.zeros_like(distance)
    rest = np.linalg.norm(tracks[0][around] - tracks[0][around[:, :1]], axis=2)
    for track in tracks[1:]:
        length = np.linalg.norm(track[around] - track[around[:, :1]], axis=2)
        np.maximum(stretch, np.abs(length - rest), out=stretch)
    share *= np.exp(-((stretch / (LOOSENESS * reach)) ** 2))
    share /= share.sum(axis=1, keepdims=True)
    gaussians, joints = tracks.shape[1], skeleton.positions.shape[1]
    weights: Any = _rows(around, share, gaussians) @ _rows(skeleton.indices, skeleton.weights, joints)
    mean = _neighbor_mean(surface)
    for _ in range(SMOOTHING):
        weights = 0.5 * (weights + mean @ weights)
    indices, weights = _largest(weights)
    fields = {**vars(skeleton), "indices": indices.astype(np.int32), "weights": weights}
    return Skeleton(**fields)


def _rows(columns: np.ndarray, values: np.ndarray, width: int) -> csr_matrix:
    """Return the matrix [R, width] with ``values`` [R, K] at ``columns`` [R, K] of each row."""
    count, each = columns.shape
    return csr_matrix((values.ravel(), (np.arange(count).repeat(each), columns.ravel())), shape=(count, width))


def _largest(matrix: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns [V, ``INFLUENCES``] of the largest entries of each row, and the entries, whose sum is 1."""
    columns, values = [], []
    for first in range(0, matrix.shape[0], CHUNK):
        dense = matrix[first : first + CHUNK].toarray()
        columns.append(np.argsort(-dense, axis=1, kind="stable")[:, :INFLUENCES])
        values.append(np.take_along_axis(dense, columns[-1], axis=1))
    weights = np.concatenate(values)
    return np.concatenate(columns), weights / weights.sum(axis=1, keepdims=True)


def posed(vertices: np.ndarray, skeleton: Skeleton, frame: int, at: int) -> np.ndarray:
    """Return the vertices [V, 3] of a mesh bound at ``frame`` as they are at frame ``at``."""
    turns = multiply(skeleton.rotations[at], conjugate(skeleton.rotations[frame]))
    before, after = skeleton.positions[frame], skeleton.positions[at]
    total = np.zeros_like(vertices)
    for column in range(skeleton.indices.shape[1]):
        joint, weight = skeleton.indices[:, column], skeleton.weights[:, column, None]
        total += weight * (rotate(turns[joint], vertices - before[joint]) + after[joint])
    return total


def _neighbor_mean(surface: Surface) -> csr_matrix:
    """Return the matrix [V, V] that takes the mean over the neighbours of each vertex."""
    faces = surface.faces
    ends = np.concatenate([faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()])
    others = np.concatenate([faces[:, [1, 2, 0]].ravel(), faces[:, [0, 1, 2]].ravel()])
    count = len(surface.vertices)
    matrix = csr_matrix((np.ones(len(ends)), (ends, others)), shape=(count, count))
    return csr_matrix(diags(1.0 / np.maximum(np.asarray(matrix.sum(axis=1)).ravel(), 1.0)) @ matrix)


def _distances(points: np.ndarray) -> np.ndarray:
    """Return distances [M, M] between points [M, 3]."""
    return cdist(points, points)
