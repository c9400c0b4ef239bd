"""Slow twins of glTF posing, float64: one vertex and one keyframe at a time, rotations by SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp


def skinned(
    positions: np.ndarray, joints: np.ndarray, weights: np.ndarray, inverse: np.ndarray, world: np.ndarray
) -> np.ndarray:
    """[P, 3] linear blend skinning: ``sum_j w_j world_j inverse_j p``.

    Args:
        positions: [P, 3]
        joints, weights: [P, K]
        inverse, world: [J, 4, 4]
    """
    found = []
    for position, of_vertex, shares in zip(positions, joints, weights):
        point = np.zeros(4)
        for joint, share in zip(of_vertex, shares):
            point += share * (world[joint] @ inverse[joint] @ np.append(position, 1.0))
        found.append(point[:3])
    return np.array(found)


def node_world(nodes: list[dict[str, Any]], index: int) -> np.ndarray:
    """[4, 4] of a node from the document's JSON: the product of the local matrices from the root down."""
    node = nodes[index]
    local = np.eye(4)
    local[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix() @ np.diag(
        node.get("scale", [1, 1, 1])
    )
    local[:3, 3] = node.get("translation", [0, 0, 0])
    for parent, other in enumerate(nodes):
        if index in other.get("children", []):
            return node_world(nodes, parent) @ local
    return local


def rotation_between(times: np.ndarray, quats: np.ndarray, seconds: float) -> np.ndarray:
    """[3, 3] spherical interpolation of xyzw keyframes, the shorter way."""
    return Slerp(times, Rotation.from_quat(quats))(np.clip(seconds, times[0], times[-1])).as_matrix()


def cubic(times: np.ndarray, values: np.ndarray, seconds: float) -> np.ndarray:
    """A Hermite spline of [N, 3, C] (in-tangent, value, out-tangent): each interval by itself."""
    seconds = float(np.clip(seconds, times[0], times[-1]))
    k = min(int(np.searchsorted(times, seconds, side="right")) - 1, len(times) - 2)
    piece = CubicHermiteSpline(times[k : k + 2], values[k : k + 2, 1], [values[k, 2], values[k + 1, 0]])
    return piece(seconds)
