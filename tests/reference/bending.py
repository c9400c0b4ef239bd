"""Bending of Gaussians by an edit, one Gaussian at a time, in float64."""

from __future__ import annotations

import numpy as np

from scgs_warp.edit.rotations import multiply, to_matrix

NEGLIGIBLE = 0.01
"""Relative stretch up to which nothing widens."""


def bend(mean, quat, scale, nodes, shifts, turns, stretches, weights, dual: bool, widest: float):
    """Return the moved mean [3], the covariance [3, 3], and the rotation [4] of one Gaussian with K control points."""
    first = turns[np.flatnonzero(weights)[0]]
    sign = np.where(turns @ first < 0, -1.0, 1.0)
    real = (weights[:, None] * sign[:, None] * turns).sum(0)
    steps = np.array([to_matrix(r) @ (mean - p) + p + t - mean for r, p, t in zip(turns, nodes, shifts)])
    shift = (weights[:, None] * steps).sum(0)
    if dual:
        offset = sum(
            0.5 * w * s * multiply(np.array([0.0, *step]), r) for w, s, step, r in zip(weights, sign, steps, turns)
        )
        back = real * [1, -1, -1, -1]
        shift = 2.0 * multiply(offset, back)[1:] / (real @ real)
    turn = real / np.linalg.norm(real)
    stretch = np.einsum("k,kij->ij", weights, stretches)
    values, vectors = np.linalg.eigh(0.5 * (stretch + stretch.T))
    limited = values.clip(1.0, widest)
    wide = vectors @ np.diag(limited) @ vectors.T if limited.max() > 1.0 + NEGLIGIBLE else np.eye(3)
    F = to_matrix(turn) @ wide @ to_matrix(quat / np.linalg.norm(quat)) @ np.diag(scale)
    return mean + shift, F @ F.T, turn
