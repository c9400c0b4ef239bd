"""Quaternions (wxyz) in float64 NumPy for handles, keyframes and poses; functions broadcast over leading dimensions."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
NEXT, LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
"""For each axis, the two others in the order of the cross product."""


def unit(quats: ArrayLike) -> np.ndarray:
    """Normalise quaternions; a norm of 0 gives the identity."""
    quats = np.asarray(quats, np.float64)
    norm = np.linalg.norm(quats, axis=-1, keepdims=True)
    return np.where(norm > 0, quats / np.where(norm > 0, norm, 1.0), IDENTITY)


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the Hamilton product: first ``b``, then ``a``."""
    aw, ax, ay, az = _components(a)
    bw, bx, by, bz = _components(b)
    return _together([
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ])  # fmt: skip


def _components(quats: np.ndarray) -> list[np.ndarray]:
    quats = np.asarray(quats, np.float64)
    return [quats[..., k] for k in range(4)]


def _together(components: list[np.ndarray]) -> np.ndarray:
    """Stack components along a last axis; for numbers, ``np.array`` takes a tenth of the time of ``np.stack``."""
    return np.stack(components, -1) if components[0].ndim else np.array(components)


def conjugate(quats: np.ndarray) -> np.ndarray:
    return np.asarray(quats, np.float64) * np.array([1.0, -1.0, -1.0, -1.0])


def to_matrix(quats: np.ndarray) -> np.ndarray:
    """Convert unit quaternions to rotation matrices [..., 3, 3]."""
    w, x, y, z = _components(quats)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return _together(rows).reshape(*w.shape, 3, 3)


def from_matrix(matrices: np.ndarray) -> np.ndarray:
    """Convert rotation matrices to unit quaternions [..., 4], w >= 0; the identity is exact."""
    m = np.asarray(matrices, np.float64)
    flat = m.reshape(-1, 3, 3)
    a, b, c = flat[:, 0, 0], flat[:, 1, 1], flat[:, 2, 2]
    # Rows are four times the products of one component of q with all four; the largest square is at least 1/4.
    squares = np.stack([1 + a + b + c, 1 + a - b - c, 1 - a + b - c, 1 - a - b + c], axis=1)
    wx, wy, wz = flat[:, 2, 1] - flat[:, 1, 2], flat[:, 0, 2] - flat[:, 2, 0], flat[:, 1, 0] - flat[:, 0, 1]
    xy, xz, yz = flat[:, 1, 0] + flat[:, 0, 1], flat[:, 2, 0] + flat[:, 0, 2], flat[:, 2, 1] + flat[:, 1, 2]
    table = np.stack(
        [
            np.stack([squares[:, 0], wx, wy, wz], 1),
            np.stack([wx, squares[:, 1], xy, xz], 1),
            np.stack([wy, xy, squares[:, 2], yz], 1),
            np.stack([wz, xz, yz, squares[:, 3]], 1),
        ],
        axis=1,
    )
    quats = unit(table[np.arange(len(flat)), squares.argmax(1)]) + 0.0
    return np.where(quats[:, :1] < 0, -quats, quats).reshape(*m.shape[:-2], 4)


def from_axis(axis: ArrayLike, degrees: float) -> np.ndarray:
    """Return the rotation about an axis of any length; length 0 gives the identity."""
    axis = np.asarray(axis, np.float64)
    norm = float(np.linalg.norm(axis))
    if not norm > 0:
        return IDENTITY.copy()
    half = math.radians(degrees) / 2
    return np.concatenate([[math.cos(half)], math.sin(half) * axis / norm])


def least_turn(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the least rotation [4] that takes one direction [3] to another; the identity if one of them is 0.

    Between opposite directions it is half a turn about an axis across them.
    """
    a, b = np.linalg.norm(first), np.linalg.norm(second)
    if not min(a, b) > 1e-9:
        return IDENTITY.copy()
    u, v = first / a, second / b
    half = np.array([1.0 + u @ v, *np.cross(u, v)])
    size = np.linalg.norm(half)
    if size > 1e-6:
        return half / size
    across = np.cross(u, np.eye(3)[np.abs(u).argmin()])
    return np.array([0.0, *(across / np.linalg.norm(across))])


def rotate(quats: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Turn vectors [..., 3] by unit quaternions [..., 4]; they broadcast."""
    quats, vectors = np.asarray(quats, np.float64), np.asarray(vectors, np.float64)
    axis = quats[..., 1:]
    twice = 2.0 * _cross(axis, vectors)
    return vectors + quats[..., :1] * twice + _cross(axis, twice)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return ``np.cross(a, b)``, whose checks take most of the time of inverse kinematics."""
    return a[..., NEXT] * b[..., LAST] - a[..., LAST] * b[..., NEXT]


def logarithm(quats: np.ndarray) -> np.ndarray:
    """Convert unit quaternions to rotation vectors [..., 3]: axis times angle, at most pi."""
    quats = np.asarray(quats, np.float64)
    quats = np.where(quats[..., :1] < 0, -quats, quats)
    sine = np.linalg.norm(quats[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quats[..., :1])
    return quats[..., 1:] * np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 2.0)


def exponential(vectors: np.ndarray) -> np.ndarray:
    """Convert rotation vectors to unit quaternions, the inverse of ``logarithm``."""
    vectors = np.asarray(vectors, np.float64)
    angle = np.linalg.norm(vectors, axis=-1, keepdims=True)
    factor = 0.5 * np.sinc(angle / (2.0 * np.pi))
    return np.concatenate([np.cos(angle / 2.0), factor * vectors], axis=-1)


def power(quats: np.ndarray, share: float) -> np.ndarray:
    """Scale rotations by ``share`` along the shorter arc from the identity; exact at 0 and 1."""
    if share == 1.0:
        return np.asarray(quats, np.float64)
    return exponential(share * logarithm(quats))


def slerp(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    """Interpolate from ``a`` to ``b`` along the shorter arc."""
    return multiply(a, power(multiply(conjugate(a), b), share))


def angle(quats: np.ndarray) -> np.ndarray:
    """Return rotation angles [...] in radians, 0 to pi."""
    return np.linalg.norm(logarithm(quats), axis=-1)


def mean(quats: np.ndarray) -> np.ndarray:
    """Average quaternions [T, M, 4] over T: [M, 4], w >= 0, the principal eigenvectors of the sums of q q^T."""
    outer = np.einsum("tmi,tmj->mij", quats, quats)
    means = np.linalg.eigh(outer)[1][..., -1]
    return np.where(means[:, :1] < 0, -means, means)


def rigid_fit(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit the motion ``x -> R (x - before) + after`` from points [P, 3] to points [P, 3] (Kabsch). A single point,
    or coincident ones, give a pure translation.

    Returns:
        Quaternion of R, mean of the points before, and mean of those after.
    """
    from_centre, to_centre = before.mean(0), after.mean(0)
    S = (after - to_centre).T @ (before - from_centre)
    if not np.abs(S).max() > 1e-60:
        return IDENTITY.copy(), from_centre, to_centre
    U, _, Vt = np.linalg.svd(S / np.abs(S).max())
    flip = np.diag([1.0, 1.0, 1.0 if np.linalg.det(U) * np.linalg.det(Vt) > 0 else -1.0])
    return from_matrix(U @ flip @ Vt), from_centre, to_centre
