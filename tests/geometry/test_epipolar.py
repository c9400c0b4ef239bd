"""The fundamental matrix of point pairs, also where they lie in a plane."""

from __future__ import annotations

import numpy as np

from scgs_warp.geometry.epipolar import fundamental_matrix


def grid() -> np.ndarray:
    y, x = np.mgrid[6:60:12, 6:200:12]
    return np.stack([x.ravel(), y.ravel()], 1).astype(np.float32)


def test_points_that_leave_the_lines_do_not_fit():
    """A camera that moves to the side: lines are rows."""
    rng = np.random.default_rng(0)
    starts = grid()
    targets = starts + np.stack([rng.uniform(2, 30, len(starts)), rng.normal(0, 0.05, len(starts))], 1)
    targets[::10, 1] += 8
    matrix, inside = fundamental_matrix(starts, targets.astype(np.float32), 0.5)
    assert matrix is not None and inside is not None and matrix.shape == (3, 3)
    assert not inside[::10].any() and np.delete(inside, np.s_[::10]).mean() > 0.95


def test_points_that_hardly_leave_a_plane():
    """OpenCV fails for some of these."""
    starts = grid()
    for seed in range(400):
        rng = np.random.default_rng(seed)
        noise = rng.normal(0, rng.choice([0.02, 0.1, 0.5, 2.0]), starts.shape)
        targets = starts @ np.array([[1.01, 0.02], [-0.02, 1.0]]) + noise
        matrix, inside = fundamental_matrix(starts, targets.astype(np.float32), 0.5)
        assert matrix is None or (inside is not None and inside.shape == (len(starts),))


def test_too_few_points():
    assert fundamental_matrix(grid()[:3], grid()[:3], 0.5) == (None, None)
