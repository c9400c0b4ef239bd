"""Control points of a static scene: sampled among opaque Gaussians, and exact at rest."""

from __future__ import annotations

import torch

from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.motion.static_nodes import SPACINGS, StaticNodes, spacing
from scgs_warp.types import Pose


def cloud(device: str, count: int = 300):
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)).to(device)
    gaussians = gaussians_from_points(points, None, sh_degree=0, hyper_columns=0)
    with torch.no_grad():
        gaussians.opacity_logits.fill_(2.0)
    return gaussians


def test_floaters_and_non_finite_gaussians_have_no_control_point(device):
    gaussians = cloud(device)
    with torch.no_grad():
        gaussians.means[0] = 50.0
        gaussians.opacity_logits[0] = -5.0  # transparent and far away
        gaussians.means[1] = 60.0  # opaque and far away: outside the core
        gaussians.means[2, 0] = float("nan")
    nodes = StaticNodes.sample(gaussians, 40)
    assert len(nodes) == 40 and float(nodes.positions.max()) <= 1.0
    assert len(torch.unique(nodes.positions, dim=0)) == 40
    torch.testing.assert_close(nodes.radii, spacing(nodes.positions) * SPACINGS)
    assert list(nodes.parameters()) == []


def test_fewer_gaussians_than_control_points(device):
    assert len(StaticNodes.sample(cloud(device, 3), 40)) == 3


def test_only_followers_of_moved_control_points_change(device):
    gaussians = cloud(device)
    nodes = StaticNodes.sample(gaussians, 30)
    binding = nodes.binding(gaussians)
    torch.testing.assert_close(binding[1].sum(1), torch.ones(300, device=device))
    rest = gaussians.activate()
    still = nodes.poses(torch.tensor([0.5]))[0]
    posed = nodes.apply_pose(gaussians, still, binding)
    assert torch.equal(posed.means, rest.means) and torch.equal(posed.quats, rest.quats)
    moves = torch.zeros(30, 3, device=device)
    moves[7, 2] = 0.5
    posed = nodes.apply_pose(gaussians, Pose(moves, still.rotations), binding)
    follows = (binding[0] == 7).any(1)
    assert 0 < int(follows.sum()) < 300
    assert torch.equal(posed.means[~follows], rest.means[~follows])
    assert bool((posed.means[follows, 2] > rest.means[follows, 2]).all())


def test_spacing_of_few():
    assert spacing(torch.zeros(1, 3)).tolist() == [1.0]
    line = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0]])
    torch.testing.assert_close(spacing(line), torch.tensor([2.0, 1.5, 2.5]))
