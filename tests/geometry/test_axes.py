"""Names of axes as unit vectors."""

from __future__ import annotations

from typing import get_args

import numpy as np

from scgs_warp.geometry.axes import Axis, direction


def test_six_directions():
    vectors = np.array([direction(axis) for axis in get_args(Axis)])
    np.testing.assert_array_equal(vectors, np.concatenate([np.eye(3), -np.eye(3)]))
