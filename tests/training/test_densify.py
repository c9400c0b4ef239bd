"""Rows come and go, moments with them; stage 1 keeps enough spheres; control points adapt."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from helpers.tiny import tiny_config
from scgs_warp.config.presets import DensifyConfig, preset, with_steps
from scgs_warp.gaussians import GaussianParameters, gaussians_from_points
from scgs_warp.motion.control_points import ControlPoints, heads_of, make_network
from scgs_warp.motion.node_density import adapt_control_points
from scgs_warp.optim import Adam
from scgs_warp.seeding import generator
from scgs_warp.training.densify import densify, prune, reset_opacities, threshold
from scgs_warp.training.density_control import _nodes_due
from scgs_warp.training.pretrain import begin_spheres, control_points_of, densify_spheres, thin_spheres
from scgs_warp.types import Stats

RATES = dict.fromkeys(GaussianParameters.NAMES, 1e-3)


def make(count: int, device: str, seed: int = 0):
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed)).to(device)
    gaussians = gaussians_from_points(points, None, sh_degree=1, hyper_dim=2)
    with torch.no_grad():
        gaussians.opacity_logits.fill_(2.0)
    optimizer = Adam(dict(gaussians.named_parameters()), RATES)
    for parameter in gaussians.parameters():
        parameter.grad = torch.arange(parameter.numel(), device=device).reshape(parameter.shape).float() + 1.0
    optimizer.step()
    return gaussians, optimizer


def moments(optimizer, name: str):
    return optimizer.groups[name].parameter, optimizer.groups[name].exp_avg


def run_densify(gaussians, optimizer, gradient, config, **options):
    stats = Stats.zeros(len(gaussians), gradient.device)
    stats.count.fill_(2.0)
    stats.grad_norm.copy_(gradient * 2.0)
    defaults = {"grad_threshold": 0.5, "extent": 1.0, "prune_large": False, "random": generator(0, 1)}
    densify(gaussians, optimizer, stats, config, **{**defaults, **options})


def test_small_ones_are_cloned_large_ones_split(device):
    gaussians, optimizer = make(4, device)
    with torch.no_grad():
        gaussians.log_scales.copy_(torch.tensor([0.001, 0.001, 0.5, 0.5]).log()[:, None].expand(4, 3))
    before = {name: getattr(gaussians, name).detach().clone() for name in GaussianParameters.NAMES}
    first = moments(optimizer, "means")[1].clone()
    run_densify(gaussians, optimizer, torch.tensor([1.0, 0.0, 1.0, 0.0], device=device), DensifyConfig())
    # rows: 0 1 3 kept, clone of 0, two halves of 2
    assert len(gaussians) == 6
    assert torch.equal(gaussians.means[:4], before["means"][[0, 1, 3, 0]])
    assert torch.allclose(gaussians.scales()[4:], torch.full((2, 3), 0.5 / 1.6, device=device))
    assert not torch.equal(gaussians.means[4], gaussians.means[5])
    parameter, average = moments(optimizer, "means")
    assert parameter is gaussians.means
    assert torch.equal(average[:3], first[[0, 1, 3]])
    assert not average[3:].any(), "new rows start without momentum"
    for name in GaussianParameters.NAMES:
        assert getattr(gaussians, name).shape[0] == 6


def test_budget_takes_the_largest_gradients(device):
    gaussians, optimizer = make(10, device)
    gradient = torch.arange(10, device=device).float() + 1.0
    marks = gaussians.means.detach().clone()
    run_densify(gaussians, optimizer, gradient, DensifyConfig(max_gaussians=12, percent_dense=10.0))
    assert len(gaussians) == 12
    assert torch.equal(gaussians.means[10:], marks[[8, 9]])


def test_transparent_large_and_broken_ones_go(device):
    gaussians, optimizer = make(5, device)
    with torch.no_grad():
        gaussians.log_scales.fill_(-4.0)
        gaussians.opacity_logits[0] = -9.0
        gaussians.log_scales[1] = 3.0
        gaussians.means[2, 1] = float("nan")
    run_densify(gaussians, optimizer, torch.zeros(5, device=device), DensifyConfig(), prune_large=True)
    assert len(gaussians) == 2


def test_pruning_everything_keeps_one(device):
    gaussians, optimizer = make(3, device)
    prune(gaussians, optimizer, torch.zeros(3, dtype=torch.bool, device=device))
    assert len(gaussians) == 1


def test_opacity_reset(device):
    gaussians, optimizer = make(3, device)
    reset_opacities(gaussians, optimizer)
    assert float(gaussians.opacities().detach().max()) <= 0.01 + 1e-6
    assert not moments(optimizer, "opacity_logits")[1].any()


def test_threshold_follows_the_resolution():
    config = DensifyConfig(grad_threshold=2e-4, resolution_exponent=0.66)
    assert threshold(config, 800, 800) == pytest.approx(2e-4)
    assert 4.8e-4 < threshold(config, 200, 200) < 5.2e-4


@pytest.mark.parametrize("opaque", [0, 3, 32])
def test_stage_one_never_falls_below_its_count(opaque, device):
    config = tiny_config()
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(1)).to(device)
    gaussians, spheres = begin_spheres(config, points, points, device)
    optimizer = Adam(dict(gaussians.named_parameters()), RATES)
    with torch.no_grad():
        gaussians.opacity_logits.fill_(-9.0)
        gaussians.opacity_logits[:opaque] = 1.0
    stats = Stats.zeros(len(gaussians), device)
    densify_spheres(gaussians, optimizer, spheres, stats, config, 3)
    assert len(gaussians) >= config.motion.nodes
    thin_spheres(gaussians, optimizer, spheres, config.motion.nodes)
    assert len(gaussians) == config.motion.nodes
    nodes = control_points_of(gaussians, spheres, config)
    assert nodes.positions.shape == (config.motion.nodes, 3)
    assert len(set(nodes.log_radii.tolist())) == 1


@pytest.mark.parametrize("solid", [4, 16, 40])
def test_control_points_are_no_strays(solid, device):
    """Spheres that show nothing lie anywhere, and far away: only what solid ones leave open is filled with them."""
    config = tiny_config()
    points = torch.rand(64, 3, generator=torch.Generator().manual_seed(2)).to(device)
    points[solid:] *= 50.0
    gaussians, spheres = begin_spheres(config, points, points, device)
    order = torch.cdist(gaussians.means.detach(), points).argmin(1)
    with torch.no_grad():
        gaussians.opacity_logits.copy_(torch.where(order < solid, 1.0, -3.0))
    optimizer = Adam(dict(gaussians.named_parameters()), RATES)
    nodes = config.motion.nodes
    thin_spheres(gaussians, optimizer, spheres, nodes)
    assert len(gaussians) == nodes
    assert int((gaussians.opacities() > 0.5).sum()) == min(solid, nodes)
    positions = control_points_of(gaussians, spheres, config).positions.detach()
    assert solid < nodes or float(positions.abs().max()) <= 1.0


def test_few_control_points_begin_among_as_many_spheres_as_more_would(device):
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(3)).to(device)
    counts = []
    for nodes in (16, 256, 400):
        config = tiny_config(motion={"nodes": nodes})
        counts.append(len(begin_spheres(config, points, points, device)[0]))
    assert counts == [2048, 2048, 3200]


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


@pytest.mark.parametrize(
    "name, steps, due",
    [
        ("paper", 80_000, [5_100, 10_200, 15_000, 20_100, 25_200]),
        ("paper", 40_000, [2_550, 5_100, 7_500, 10_050, 12_600]),
        ("cpu", 24_000, [2_000, 4_000, 6_000, 8_000]),
    ],
)
def test_control_points_change_at_the_first_round_after_each_milestone(name, steps, due):
    config = with_steps(preset(name), steps)
    state = SimpleNamespace(config=config, motion=ControlPoints.__new__(ControlPoints))
    rounds = range(config.densify.interval, config.densify.until + 1, config.densify.interval)
    assert [done for done in rounds if _nodes_due(state, done)] == due
