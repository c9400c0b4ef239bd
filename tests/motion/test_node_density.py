"""Adaptive control points: cloned where gradients are large, pruned where they move nothing."""

from __future__ import annotations

import pytest
import torch

from helpers.tiny import tiny_config
from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.motion.control_points import ControlPoints, heads_of, make_network
from scgs_warp.motion.node_density import adapt_control_points


def motion_and_gaussians(counts: list[int]):
    """Control points far from each other, with ``counts`` Gaussians at each; their optimiser, and gradients of 1."""
    config = tiny_config(motion={"hyper_dim": 0}).motion
    positions = torch.tensor([[10.0 * i, 0.0, 0.0] for i in range(len(counts))])
    network = make_network(config, heads_of(config), 0)
    motion = ControlPoints(positions, torch.full((len(counts),), 0.2), network, config)
    points = positions.repeat_interleave(torch.tensor(counts), dim=0)
    gaussians = gaussians_from_points(points, None, sh_degree=0, hyper_columns=0)
    optimizer = motion.optimizer(tiny_config())
    assert optimizer is not None
    return motion, optimizer, gaussians, torch.ones(len(points))


@pytest.mark.parametrize(("least_impact", "left"), [(0.0, 9), (1.0, 8), (2.0, 7), (3.5, 6), (8.5, 5), (100.0, 5)])
def test_control_points_that_move_too_few_gaussians_go(least_impact, left):
    """Their weights sum to the number of Gaussians beside them; K + 1 stay in any case."""
    motion, optimizer, gaussians, gradient = motion_and_gaussians([0, 1, 3, 4, 5, 6, 7, 8, 9])
    pruned = adapt_control_points(motion, optimizer, gaussians, gradient, grad_threshold=2.0, least_impact=least_impact)
    assert pruned == (0, 9 - left)
    assert motion.positions[:, 0].tolist() == [10.0 * i for i in range(9 - left, 9)]


@pytest.mark.parametrize(("growth", "clones"), [(0.1, 1), (0.5, 5), (1.0, 10)])
def test_growth_is_a_share_of_the_control_points(growth, clones):
    motion, optimizer, gaussians, gradient = motion_and_gaussians([2] * 10)
    changed = adapt_control_points(motion, optimizer, gaussians, gradient, grad_threshold=0.5, growth=growth)
    assert changed == (clones, 0) and len(motion) == 10 + clones


def test_control_points_clone_where_the_image_pulls_and_idle_ones_go(device):
    config = tiny_config(motion={"hyper_dim": 0}).motion
    positions = torch.tensor([[float(i), 0.0, 0.0] for i in range(6)] + [[0.0, 0.0, 90.0]], device=device)
    motion = ControlPoints(
        positions, torch.full((7,), 0.2, device=device), make_network(config, heads_of(config), 0), config
    )
    motion = motion.to(device)
    optimizer = motion.optimizer(tiny_config())
    assert optimizer is not None
    gaussians = gaussians_from_points(positions[:6] + 0.01, None, sh_degree=0, hyper_columns=0)
    gradient = torch.zeros(6, device=device)
    gradient[2] = 1.0
    cloned, pruned = adapt_control_points(motion, optimizer, gaussians, gradient, grad_threshold=0.5)
    assert (cloned, pruned) == (1, 1)
    assert len(motion) == 7 and motion.log_radii.shape == (7,) and motion.hyper.shape[0] == 7
    assert torch.allclose(motion.positions[6], gaussians.means[2], atol=1e-3)


def test_no_clone_at_a_place_that_is_not_finite():
    """Gaussians at infinity are pruned only after this: whatever they pull has no mean place."""
    motion, optimizer, gaussians, gradient = motion_and_gaussians([2] * 6)
    with torch.no_grad():
        gaussians.means[4] = float("inf")
    changed = adapt_control_points(motion, optimizer, gaussians, gradient, grad_threshold=0.5, growth=1.0)
    assert changed == (2, 0)
    assert motion.positions[:, 0].tolist() == pytest.approx([0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 40.0, 50.0])
