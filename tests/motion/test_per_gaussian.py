"""The per-Gaussian baseline: residuals of the network at every Gaussian, after a static phase."""

from __future__ import annotations

import pytest
import torch

from helpers.tiny import tiny_config, trained_pose
from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.motion import PerGaussian, build_motion


def test_residuals_begin_after_the_static_phase(device):
    config = tiny_config(30, motion={"model": "per-gaussian"}, coarse=6)
    motion = build_motion("per-gaussian", config).to(device)
    assert isinstance(motion, PerGaussian)
    points = torch.rand(12, 3, generator=torch.Generator().manual_seed(0)).to(device)
    gaussians = gaussians_from_points(points, None, sh_degree=0, hyper_columns=0)
    with torch.no_grad():
        motion.network.head.bias.copy_(torch.arange(1.0, 11.0))
    rest = gaussians.activate()
    assert torch.equal(trained_pose(motion, gaussians, 0.4, 5, config).gaussians.means, rest.means)
    posed = trained_pose(motion, gaussians, 0.4, 6, config).gaussians
    moves = torch.tensor([5.0, 6.0, 7.0], device=device).expand(12, 3)
    torch.testing.assert_close(posed.means - rest.means, moves, rtol=1e-3, atol=1e-2)
    turns = torch.tensor([1.0, 2.0, 3.0, 4.0], device=device).expand(12, 4)
    torch.testing.assert_close(posed.quats - gaussians.quats, turns, rtol=1e-3, atol=1e-2)
    growth = torch.tensor([8.0, 9.0, 10.0], device=device).expand(12, 3)
    torch.testing.assert_close((posed.scales / rest.scales).log(), growth, rtol=1e-3, atol=1e-2)
    assert torch.equal(posed.opacities, rest.opacities) and torch.equal(posed.sh_dc, rest.sh_dc)


def test_rates_fall_from_the_end_of_the_static_phase():
    config = tiny_config(30, coarse=6, optim={"network_until": 10})
    motion = build_motion("per-gaussian", config)
    rates = [motion.rates(step, config)["network.head.weight"] for step in (0, 6, 16, 25)]
    assert rates == pytest.approx([config.optim.network] * 2 + [config.optim.network_end] * 2)
