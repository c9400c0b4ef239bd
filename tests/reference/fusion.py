"""Fusion of one depth image into a volume in float64, voxel by voxel."""

from __future__ import annotations

import numpy as np

from scgs_warp.types import Camera

LEAST_COSINE = 0.1


def _point(depth: np.ndarray, K: np.ndarray, x: int, y: int) -> np.ndarray:
    return depth[y, x] * np.array([(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], 1.0])


def cosine(depth: np.ndarray, K: np.ndarray, x: int, y: int, jump: float) -> float:
    """Cosine of the angle between a pixel's ray and the normal of the surface it shows."""
    middle, steps = _point(depth, K, x, y), []
    for dx, dy in ((1, 0), (0, 1)):
        total = np.zeros(3)
        for sign in (1, -1):
            column, row = x + sign * dx, y + sign * dy
            if not (0 <= column < depth.shape[1] and 0 <= row < depth.shape[0]) or depth[row, column] == 0:
                continue
            if abs(depth[row, column] - depth[y, x]) < jump:
                total += sign * (_point(depth, K, column, row) - middle)
        steps.append(total)
    normal = np.cross(*steps)
    size = np.linalg.norm(normal) * np.linalg.norm(middle)
    return abs(normal @ middle) / size if size > 0 else 0.0


def observe(depth: np.ndarray, camera: Camera, place: np.ndarray, truncation: float) -> tuple[float, float]:
    """What a view says about a place: a distance over the truncation, and its weight (0: nothing)."""
    K, view = camera.K.double().numpy(), camera.viewmat.double().numpy()
    point = view[:3, :3] @ place + view[:3, 3]
    if point[2] <= 0:
        return 0.0, 0.0
    u, v = (K[axis, axis] * point[axis] / point[2] + K[axis, 2] - 0.5 for axis in (0, 1))
    height, width = depth.shape
    if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
        return 0.0, 0.0
    x, y = min(int(u), width - 2), min(int(v), height - 2)
    fx, fy = u - x, v - y
    column, row = x + (fx >= 0.5), y + (fy >= 0.5)
    found = depth[row, column]
    if found == 0:
        rows, columns = np.nonzero(depth)
        pixels = np.hypot(rows - row, columns - column).min() - 0.5
        return min(pixels * point[2] / K[0, 0] / truncation, 1.0), 1.0
    corners = depth[y : y + 2, x : x + 2]
    if corners.min() > 0 and np.ptp(corners) < truncation:
        found = np.array([1 - fy, fy]) @ corners @ np.array([1 - fx, fx])
    weight = max(cosine(depth, K, column, row, truncation), LEAST_COSINE)
    distance = (found - point[2]) * np.linalg.norm(point) / point[2] * weight
    return (0.0, 0.0) if distance < -truncation else (min(distance / truncation, 1.0), weight)
