"""Laws of quaternions and rigid motions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from scgs_warp.edit.rotations import (
    conjugate,
    from_axis,
    from_matrix,
    mean,
    multiply,
    power,
    rigid_fit,
    rotate,
    to_matrix,
)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**31))
def test_quaternions_and_matrices(seed):
    random = np.random.default_rng(seed)
    quats = random.normal(size=(5, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    back = from_matrix(to_matrix(quats))
    np.testing.assert_allclose(back, np.where(quats[:, :1] < 0, -quats, quats), atol=1e-12)
    vectors = random.normal(size=(5, 3))
    np.testing.assert_allclose(rotate(quats, vectors), (to_matrix(quats) @ vectors[..., None])[..., 0], atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**31), st.integers(0, 100))
def test_rotation_algebra(seed, percent):
    random = np.random.default_rng(seed)
    a, b = (from_axis(random.normal(size=3), random.uniform(-179, 179)) for _ in range(2))
    assert power(a, 0.0)[0] == 1.0 and np.array_equal(power(a, 1.0), a)
    part = multiply(power(a, percent / 100), power(a, 1 - percent / 100))
    np.testing.assert_allclose(abs(part @ a), 1.0, atol=1e-12)
    np.testing.assert_allclose(multiply(multiply(a, b), conjugate(b)), a, atol=1e-12)
    points = random.normal(size=(6, 3))
    quat, before, after = rigid_fit(points, rotate(a, points) + b[:3])
    assert abs(quat @ a) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(rotate(quat, points - before) + after, rotate(a, points) + b[:3], atol=1e-9)
    np.testing.assert_allclose(np.abs(mean(np.stack([a, -a])[:, None]) @ a), 1.0, atol=1e-12)
    assert from_matrix(np.eye(3)).tolist() == [1.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("form", ["flat", "mirrored", "noisy"])
def test_a_rigid_fit_is_the_best_rotation_and_no_reflection(seed, form):
    """Against SciPy's, of flat pieces and of pieces turned inside out."""
    random = np.random.default_rng(seed)
    before = random.normal(size=(7, 3)) * (1.0, 0.7, 0.0 if form == "flat" else 0.4)
    turn = from_axis(random.normal(size=3), random.uniform(-179, 179))
    after = rotate(turn, before * (1.0, 1.0, -1.0 if form == "mirrored" else 1.0))
    after = after + random.normal(size=(7, 3)) * (0.1 if form == "noisy" else 0.0)
    found = rigid_fit(before, after)[0]
    expected, _ = Rotation.align_vectors(after - after.mean(0), before - before.mean(0))
    np.testing.assert_allclose(to_matrix(found), expected.as_matrix(), atol=1e-6)
    assert form != "flat" or abs(found @ turn) == pytest.approx(1.0, abs=1e-9)
