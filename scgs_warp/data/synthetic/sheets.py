"""Closed triangle meshes of thin sheets, made from a grid of points on their middle."""

from __future__ import annotations

import numpy as np


def sheet_faces(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the faces of a sheet of rows x columns grid points, and the side of each face.

    Returns:
        faces [F, 3] of the vertices that ``sheet_vertices`` makes, counter-clockwise from outside; sides [F]: 0 on the
        front, 1 on the back, 2 on the rim.
    """
    count = rows * columns
    corner = np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)
    a, b, c, d = corner, corner + columns, corner + columns + 1, corner + 1
    front = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    back = front[:, ::-1] + count
    length = len(_border(rows, columns))
    p = 2 * count + np.arange(length)
    q = 2 * count + np.roll(np.arange(length), -1)
    rim = np.concatenate([np.stack([p + length, q + length, q], -1), np.stack([p + length, q, p], -1)])
    sides = np.repeat([0, 1, 2], [len(front), len(back), len(rim)])
    return np.concatenate([front, back, rim]), sides


def sheet_vertices(middle: np.ndarray, half_thickness: float) -> np.ndarray:
    """Return the vertices [P, 3] of a sheet around grid points ``middle`` [rows, columns, 3].

    The front is on the side of the cross product of the directions of growing row and column. The rim has its own
    vertices, so that it has its own normals.
    """
    rows, columns = middle.shape[:2]
    across = np.cross(np.gradient(middle, axis=0), np.gradient(middle, axis=1))
    offset = across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12) * half_thickness
    front, back = (middle + offset).reshape(-1, 3), (middle - offset).reshape(-1, 3)
    border = _border(rows, columns)
    return np.concatenate([front, back, front[border], back[border]])


def sheet(middle: np.ndarray, half_thickness: float) -> tuple[np.ndarray, np.ndarray]:
    """Make a sheet around grid points [rows, columns, 3]: return vertices [P, 3] and faces [F, 3]."""
    return sheet_vertices(middle, half_thickness), sheet_faces(*middle.shape[:2])[0]


def grid(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates of a grid, [len(u), len(v)] each."""
    first, second = np.meshgrid(u, v, indexing="ij")
    return first, second


def _border(rows: int, columns: int) -> np.ndarray:
    """Return the indices of the grid points on the border, counter-clockwise from the front."""
    index = np.arange(rows * columns).reshape(rows, columns)
    return np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
