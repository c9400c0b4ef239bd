"""Adaptive control points: cloned where gradients are large, pruned where they move nothing."""

from __future__ import annotations

import torch

from helpers.tiny import tiny_config
from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.motion.control_points import ControlPoints, heads_of, make_network
from scgs_warp.motion.node_density import adapt_control_points


def test_control_points_clone_where_the_image_pulls_and_idle_ones_go(device):
    config = tiny_config().motion
    positions = torch.tensor([[float(i), 0.0, 0.0] for i in range(6)] + [[0.0, 0.0, 90.0]], device=device)
    motion = ControlPoints(
        positions, torch.full((7,), 0.2, device=device), make_network(config, heads_of(config), 0), config
    )
    motion = motion.to(device)
    optimizer = motion.optimizer(tiny_config())
    assert optimizer is not None
    gaussians = gaussians_from_points(positions[:6] + 0.01, None, sh_degree=0, hyper_dim=0)
    gradient = torch.zeros(6, device=device)
    gradient[2] = 1.0
    cloned, pruned = adapt_control_points(motion, optimizer, gaussians, gradient, grad_threshold=0.5)
    assert (cloned, pruned) == (1, 1)
    assert len(motion) == 7 and motion.log_radii.shape == (7,) and motion.hyper.shape[0] == 7
    assert torch.allclose(motion.positions[6], gaussians.means[2], atol=1e-3)
