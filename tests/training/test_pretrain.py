"""Stage 1: there are enough spheres, and control points are chosen among the solid ones."""

from __future__ import annotations

import pytest
import torch

from helpers.gaussian_rows import RATES
from helpers.tiny import tiny_config
from scgs_warp.optim import Adam
from scgs_warp.training.pretrain import control_points_from_spheres, densify_spheres, initial_spheres, thin_spheres
from scgs_warp.types import Stats


@pytest.mark.parametrize("opaque", [0, 3, 32])
def test_stage_one_never_falls_below_its_count(opaque, device):
    config = tiny_config()
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(1)).to(device)
    gaussians, spheres = initial_spheres(config, points, points, device)
    optimizer = Adam(dict(gaussians.named_parameters()), RATES)
    with torch.no_grad():
        gaussians.opacity_logits.fill_(-9.0)
        gaussians.opacity_logits[:opaque] = 1.0
    stats = Stats.zeros(len(gaussians), device)
    densify_spheres(gaussians, optimizer, spheres, stats, config, 3)
    assert len(gaussians) >= config.motion.nodes
    thin_spheres(gaussians, optimizer, spheres, config.motion.nodes)
    assert len(gaussians) == config.motion.nodes
    nodes = control_points_from_spheres(gaussians, spheres, config)
    assert nodes.positions.shape == (config.motion.nodes, 3)
    assert len(set(nodes.log_radii.tolist())) == 1


@pytest.mark.parametrize("solid", [4, 16, 40])
def test_control_points_are_no_strays(solid, device):
    """Spheres that show nothing lie anywhere, and far away: only what solid ones leave open is filled with them."""
    config = tiny_config()
    points = torch.rand(64, 3, generator=torch.Generator().manual_seed(2)).to(device)
    points[solid:] *= 50.0
    gaussians, spheres = initial_spheres(config, points, points, device)
    order = torch.cdist(gaussians.means.detach(), points).argmin(1)
    with torch.no_grad():
        gaussians.opacity_logits.copy_(torch.where(order < solid, 1.0, -3.0))
    optimizer = Adam(dict(gaussians.named_parameters()), RATES)
    nodes = config.motion.nodes
    thin_spheres(gaussians, optimizer, spheres, nodes)
    assert len(gaussians) == nodes
    assert int((gaussians.opacities() > 0.5).sum()) == min(solid, nodes)
    positions = control_points_from_spheres(gaussians, spheres, config).positions.detach()
    assert solid < nodes or float(positions.abs().max()) <= 1.0


def test_few_control_points_begin_among_as_many_spheres_as_more_would(device):
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(3)).to(device)
    counts = []
    for nodes in (16, 256, 400):
        config = tiny_config(motion={"nodes": nodes})
        counts.append(len(initial_spheres(config, points, points, device)[0]))
    assert counts == [2048, 2048, 3200]
