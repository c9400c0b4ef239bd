"""Gaussians made from points."""

from __future__ import annotations

import pytest
import torch

from scgs_warp.gaussians import SH_C0, gaussians_from_points, neighbor_distance


def test_neighbor_distance_of_few():
    assert neighbor_distance(torch.zeros(0, 3)).shape == (0,)
    assert neighbor_distance(torch.zeros(1, 3)).shape == (1,)
    assert float(neighbor_distance(torch.tensor([[0.0, 0, 0], [2.0, 0, 0]]))[0]) == pytest.approx(2.0)


def test_gaussians_from_points_activate_to_what_was_given():
    points = torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    colors = torch.tensor([[0.2, 0.5, 0.9], [0.0, 1.0, 0.5]])
    made = gaussians_from_points(points, colors, sh_degree=2, hyper_dim=4, scale=0.5).activate()
    assert torch.equal(made.means, points) and made.sh_rest.shape == (2, 8, 3) and not made.sh_rest.any()
    torch.testing.assert_close(made.scales, torch.ones(2, 3))
    torch.testing.assert_close(made.opacities, torch.full((2,), 0.1))
    torch.testing.assert_close(0.5 + SH_C0 * made.sh_dc, colors)
