"""Spheres of stage 1: one shared radius, at rest during the warm-up, then moved by the network and kept rigid."""

from __future__ import annotations

import math

import pytest
import torch

from helpers.tiny import tiny_config, trained_pose
from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.motion import Spheres
from scgs_warp.motion.control_points import heads_of, make_network

CONFIG = tiny_config(60, pretrain={"steps": 20, "warm_up": 6})


def model(device: str):
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)).to(device)
    gaussians = gaussians_from_points(points, None, sh_degree=0, hyper_columns=0)
    spheres = Spheres(make_network(CONFIG.motion, heads_of(CONFIG.motion), 0), 0.25).to(device)
    with torch.no_grad():
        spheres.network.head.weight.normal_(std=0.3, generator=torch.Generator(device).manual_seed(1))
    return gaussians, spheres


def test_all_have_one_radius_that_learns(device):
    gaussians, spheres = model(device)
    posed = spheres.gaussians_at(gaussians, 0.5)
    assert posed.scales.shape == (40, 3)
    torch.testing.assert_close(posed.scales, torch.full((40, 3), 0.25, device=device))
    posed.scales.sum().backward()
    assert spheres.log_radius.grad is not None
    assert float(spheres.log_radius.grad) == pytest.approx(120 * 0.25, rel=1e-5)


def test_warm_up_then_motion_then_rigidity_every_few_steps(device):
    gaussians, spheres = model(device)
    assert CONFIG.loss.arap_every == 5
    poses = {step: trained_pose(spheres, gaussians, 0.5, step, CONFIG) for step in (5, 6, 10, 11)}
    assert torch.equal(poses[5].gaussians.means, gaussians.means)
    assert not torch.equal(poses[6].gaussians.means, gaussians.means)
    carried = [step for step, pose in poses.items() if pose.regulariser is not None]
    assert carried == [10]
    regulariser = poses[10].regulariser
    assert regulariser is not None and math.isfinite(float(regulariser.detach())) and float(regulariser.detach()) > 0


def test_the_graph_is_saved_and_restored(device):
    gaussians, spheres = model(device)
    assert spheres.extra_state() == {}
    trained_pose(spheres, gaussians, 0.5, 10, CONFIG)
    saved = {name: value.clone() for name, value in spheres.extra_state().items()}
    _, other = model(device)
    other.load_extra_state(saved)
    assert other.graph is not None and spheres.graph is not None
    for mine, theirs in zip(other.extra_state().values(), spheres.extra_state().values(), strict=True):
        assert torch.equal(mine, theirs)


def test_neighbors_of_the_moment_are_found_anew_in_every_step_with_the_term(device):
    config = tiny_config(60, pretrain={"steps": 20, "warm_up": 6, "arap_by": "moment"})
    gaussians, spheres = model(device)
    graphs = []
    for time in (0.1, 0.9):
        trained_pose(spheres, gaussians, time, 10, config)
        assert spheres.graph is not None
        graphs.append(spheres.graph.neighbors.clone())
        means = spheres.gaussians_at(gaussians, time).means
        apart = torch.cdist(means, means).fill_diagonal_(math.inf)
        assert torch.equal(graphs[-1][:, 0].long(), apart.argmin(1))
    assert not torch.equal(*graphs)
    assert [step for step in range(20) if spheres.refresh_due(step, config)] == [10, 15]
    assert not any(spheres.refresh_due(step, CONFIG) for step in range(10, 20))
    _, other = model(device)
    trained_pose(other, gaussians, 0.9, 10, config)  # the same after a resume, whatever the graph before was
    assert other.graph is not None and torch.equal(other.graph.neighbors, graphs[-1])
