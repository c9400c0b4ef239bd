"""Initial points without a reconstruction: drawn where images are covered, else where the cameras look."""

from __future__ import annotations

import torch

from helpers.handheld import handheld
from helpers.tiny import tiny_dataset
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.training.initial_points import (
    HALF_SIZE,
    common_view,
    coverage,
    random_points,
    sample_initial_points,
)


def test_random_points_fill_the_cube():
    points = random_points(5000, 0)
    assert points.shape == (5000, 3) and float(points.abs().max()) <= HALF_SIZE
    assert float(points.amin()) < -0.9 * HALF_SIZE and float(points.amax()) > 0.9 * HALF_SIZE
    assert torch.equal(points, random_points(5000, 0)) and not torch.equal(points, random_points(5000, 1))


def test_points_lie_where_alpha_is_and_have_its_colour():
    data = tiny_dataset(8)
    normalisation = Normalisation.fit(data.cameras)
    points, colors = sample_initial_points(500, data, normalisation, 0)
    assert points.shape == (500, 3) and colors is not None and colors.shape == (500, 3)
    chosen, plain = (coverage(p, data, normalisation) for p in (points, random_points(500, 0)))
    assert chosen is not None and plain is not None
    assert chosen.share.mean() > 2 * plain.share.mean()
    assert bool(((colors >= 0) & (colors <= 1)).all())
    assert bool((plain.colors[plain.share == 0] == 0.5).all()), "grey where nothing covers a point"


def test_points_begin_in_the_common_view():
    """Cameras that walk past a wall do not all see all of the cube."""
    data = handheld(20, 0.0)
    for index, entry in enumerate(data.entries):
        entry.camera.viewmat[0, 3] += 0.4 * index
    normalisation = Normalisation.fit(data.cameras, distance=7.6)
    plain = random_points(2000, 0)
    points, colors = sample_initial_points(2000, data, normalisation, 0)
    assert colors is None and points.shape == (2000, 3)
    before, after = (common_view(p, data, normalisation) for p in (plain, points))
    assert after.mean() > before.mean() + 0.05 and (before < 0.3).sum() > 5 * (after < 0.3).sum()
    assert torch.equal(points, sample_initial_points(2000, data, normalisation, 0)[0])
