"""Float64 twin of ``kernels/inverse_kinematics.py``: SciPy's rotations, and one dense system per step."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation


def cross(vector: np.ndarray) -> np.ndarray:
    return np.cross(np.eye(3), vector)


def place_chain(joints, shifts, rotations, base, ends, turns: list[Rotation], shift):
    """Return the frame of each joint before its turn, the posed joints, and the posed grip."""
    frames, points, rotation, offset = [], [], base, ends[0]
    for k, (joint, own) in enumerate(zip(joints, shifts)):
        moved = joint + own + (shift if k == 0 else 0.0)
        frames.append(rotation)
        points.append(rotation @ moved + offset)
        local = turns[k].as_matrix() @ rotations[k]
        offset = rotation @ (moved - local @ joint) + offset
        rotation = rotation @ local
    return frames, points, rotation @ ends[1] + offset


def change_of_vector(vector: np.ndarray) -> np.ndarray:
    """Return the derivative of a rotation vector by a small turn that follows, by central differences."""
    step = 1e-6
    columns = [
        (Rotation.from_rotvec(d) * Rotation.from_rotvec(vector)).as_rotvec()
        - (Rotation.from_rotvec(-d) * Rotation.from_rotvec(vector)).as_rotvec()
        for d in step * np.eye(3)
    ]
    return np.stack(columns, 1) / (2.0 * step)


def reach_place(
    joints, shifts, rotations, costs, base, ends, aims: Iterable[np.ndarray], most, pull, slide, longest, tolerance
):
    """Minimise, for each aim in turn, slide |shift|^2 + sum_k v_k^T cost_k v_k + pull |end - aim|^2 by Gauss-Newton
    steps, where v_k is the rotation vector of turn k."""
    count = len(joints)
    turns, shift = [Rotation.identity() for _ in range(count)], np.zeros(3)
    for aim, iterations in zip(aims, most):
        for _ in range(iterations):
            frames, points, end = place_chain(joints, shifts, rotations, base, ends, turns, shift)
            J = np.hstack([base, *(cross(point - end) @ frame for point, frame in zip(points, frames))])
            normal, slope = pull * J.T @ J, pull * J.T @ (end - aim)
            normal[:3, :3] += slide * np.eye(3)
            slope[:3] += slide * shift
            for k in range(count):
                own, vector = slice(3 * k + 3, 3 * k + 6), turns[k].as_rotvec()
                inner = change_of_vector(vector)
                normal[own, own] += inner.T @ costs[k] @ inner
                slope[own] += inner.T @ costs[k] @ vector
            change = -np.linalg.solve(normal, slope).reshape(-1, 3)
            largest = max(np.linalg.norm(row) for row in change[1:])
            change *= min(1.0, longest / max(largest, 1e-300))
            shift = shift + change[0]
            turns = [Rotation.from_rotvec(own) * turn for own, turn in zip(change[1:], turns)]
            if min(largest, longest) < tolerance:
                break
    return np.stack([turn.as_quat() for turn in turns]), shift
