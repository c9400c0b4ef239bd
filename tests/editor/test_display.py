"""Scenes of any size in the browser's units."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from helpers.edit_scenes import OVERVIEW
from scgs_warp.editor.display import FARTHEST, RADIUS, Display


@pytest.mark.parametrize("radius", [1e-3, 2.0, 1e3])
def test_cameras_stand_at_the_same_distance_whatever_the_scene_measures(radius):
    display = Display.of(dataclasses.replace(OVERVIEW, centre=(1.0, -2.0, 3.0), radius=radius))
    points = np.array([[1.0, -2.0, 3.0], [1.0 + radius, -2.0, 3.0]])
    shown = display.show(points)
    np.testing.assert_allclose(shown, [[0, 0, 0], [RADIUS, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(display.world(shown), points, rtol=1e-12)


def test_depth_is_shifted_and_ends_where_the_browser_ends():
    display = Display((0.0, 0.0, 0.0), 2.0)
    depth = display.depth(np.array([[1.0, np.inf], [3.0, 1e6]], np.float32), 0.5)
    np.testing.assert_array_equal(depth, [[2.5, FARTHEST], [6.5, FARTHEST]])
    assert display.depth(np.ones((4, 6), np.float32), 0.0, 2).shape == (2, 3)
    assert (display.empty_depth == FARTHEST).all()
