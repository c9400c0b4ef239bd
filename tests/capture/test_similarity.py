"""Similarity transforms: alignment of points, cameras moved with them, scenes put upright."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.layouts import POINTS, viewmat
from scgs_warp.capture.similarity import Similarity, align, centres, upright


def random_similarity(seed: int) -> Similarity:
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Similarity(float(rng.uniform(0.1, 9)), q * np.sign(np.linalg.det(q)), rng.normal(size=3) * 5)


@pytest.mark.parametrize("seed", range(3))
def test_alignment_finds_the_similarity(seed):
    truth = random_similarity(seed)
    points = np.random.default_rng(seed).normal(size=(20, 3))
    found = align(points, truth.points(points))
    assert found.scale == pytest.approx(truth.scale)
    np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-8)
    mirrored = align(points, points * [1, 1, -1])
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1), "a mirror image is not aligned by mirroring"


def test_moved_cameras_see_moved_points_where_they_were():
    moved, views = random_similarity(4), np.stack([viewmat(index) for index in range(6)])
    after = moved.viewmats(views)
    np.testing.assert_allclose(centres(after), moved.points(centres(views)), atol=1e-9)
    for old, new in zip(views, after):
        seen = POINTS @ old[:3, :3].T + old[:3, 3]
        again = moved.points(POINTS) @ new[:3, :3].T + new[:3, 3]
        np.testing.assert_allclose(again, moved.scale * seen, atol=1e-9)
        np.testing.assert_allclose(new[:3, :3] @ new[:3, :3].T, np.eye(3), atol=1e-12)


def test_scenes_are_put_upright():
    views = random_similarity(2).viewmats(np.stack([viewmat(index, 0.3) for index in range(8)]))
    points = random_similarity(2).points(POINTS)
    placed = upright(views, points)
    np.testing.assert_allclose(np.median(placed.points(points), axis=0), 0, atol=0.5)
    after = placed.viewmats(views)
    assert (after[:, 1, 2] < -0.7).all(), "the images' down is the world's down"
    assert np.abs(after[:, 0, 2]).max() < 1e-6, "cameras were level"
    assert np.median(np.linalg.norm(centres(after), axis=1)) == pytest.approx(4, rel=0.2)
