"""Gaussians from points: the distance to neighbours is defined for any number of points."""

from __future__ import annotations

import pytest
import torch

from scgs_warp.gaussians import neighbor_distance


def test_neighbor_distance_of_few():
    assert neighbor_distance(torch.zeros(0, 3)).shape == (0,)
    assert neighbor_distance(torch.zeros(1, 3)).shape == (1,)
    assert float(neighbor_distance(torch.tensor([[0.0, 0, 0], [2.0, 0, 0]]))[0]) == pytest.approx(2.0)
