"""Stage 1: there are enough spheres, and control points are chosen among the solid ones."""

from __future__ import annotations

import pytest
import torch

from helpers.gaussian_rows import RATES
from helpers.tiny import tiny_config
from scgs_warp.optim import Adam
from scgs_warp.training.initial_models import control_points_from_spheres, initial_spheres
from scgs_warp.training.sphere_density import densify_spheres, densify_spheres_by_gradient, thin_spheres
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


def by_gradient(**pretrain):
    """Settings of the official form of stage 1, with 16 control points."""
    return tiny_config(pretrain={"densify_by": "gradient", "start_ratio": 1.0, "max_ratio": 4.0, **pretrain})


def round_by_gradient(config, gradient, extent, radius, opacities=0.9):
    """One round over spheres in a row whose mean gradients are ``gradient``; returns them, with the common radius."""
    count = len(gradient)
    points = torch.linspace(-1.0, 1.0, count)[:, None].repeat(1, 3)
    gaussians, spheres = initial_spheres(config, points, points, "cpu")
    optimizer = Adam(dict(gaussians.named_parameters()), RATES)
    with torch.no_grad():
        gaussians.means.copy_(points)
        gaussians.opacity_logits.copy_(torch.as_tensor(opacities).expand(count).logit())
        spheres.log_radius.fill_(radius).log_()
    stats = Stats.zeros(count, "cpu")
    stats.grad_norm += 3.0 * torch.as_tensor(gradient)
    stats.count += 3.0
    densify_spheres_by_gradient(gaussians, optimizer, spheres, stats, config, extent, 3)
    return gaussians, float(spheres.log_radius.detach().exp())


def test_small_spheres_are_cloned_by_their_gradient():
    gradient = torch.full((16,), 1.99e-4)
    gradient[[2, 5]] = 2.01e-4
    gaussians, radius = round_by_gradient(by_gradient(), gradient, 4.0, 0.039)
    assert len(gaussians) == 18 and radius == pytest.approx(0.039)
    assert torch.equal(gaussians.means[16:], gaussians.means[[2, 5]])
    assert len(round_by_gradient(by_gradient(grad_threshold=1e-4), gradient, 4.0, 0.039)[0]) == 32


def test_large_spheres_are_split_and_all_of_them_shrink():
    """The common size is the geometric mean of 14 whole ones and 4 halves."""
    gradient = torch.zeros(16)
    gradient[[2, 5]] = 1.0
    gaussians, radius = round_by_gradient(by_gradient(), gradient, 4.0, 0.041)
    assert len(gaussians) == 18 and radius == pytest.approx(0.041 * 1.6 ** (-4 / 18))
    kept = [index for index in range(16) if index not in (2, 5)]
    assert torch.equal(gaussians.means[:14], torch.linspace(-1.0, 1.0, 16)[kept, None].repeat(1, 3))


@pytest.mark.parametrize("opaque", [0, 1, 15, 16])
def test_a_round_by_gradient_leaves_enough_spheres(opaque):
    """Also where one size for all would prune all of them: spheres larger than a tenth of the extent stay."""
    opacities = torch.full((16,), 0.0049)
    opacities[:opaque] = 0.0051
    gaussians, _ = round_by_gradient(by_gradient(), torch.zeros(16), 1.0, 0.5, opacities)
    assert len(gaussians) == 16
    assert opaque == 0 or bool((gaussians.opacities() > 0.005).all())


def test_a_round_by_gradient_keeps_the_cap():
    gaussians, _ = round_by_gradient(by_gradient(max_ratio=1.5), torch.ones(16), 4.0, 0.01)
    assert len(gaussians) == 24
    gaussians, _ = round_by_gradient(by_gradient(max_ratio=1.0, start_ratio=2.0), torch.ones(32), 4.0, 0.01)
    assert len(gaussians) == 32, "a start above the cap is kept, but does not grow"


def round_by_share(opacities: torch.Tensor, gradient: torch.Tensor, step: int, **pretrain):
    """One round over spheres in a row, far from each other; returns them, and their former places."""
    config, count = tiny_config(pretrain=pretrain), len(opacities)
    places = torch.arange(float(count))[:, None].repeat(1, 3)
    gaussians, spheres = initial_spheres(config, places, places, "cpu")
    assert len(gaussians) == count
    optimizer = Adam(dict(gaussians.named_parameters()), RATES)
    with torch.no_grad():
        gaussians.means.copy_(places)
        gaussians.opacity_logits.copy_(opacities.logit())
        spheres.log_radius.fill_(0.01).log_()
    stats = Stats.zeros(count, "cpu")
    stats.grad_norm += gradient
    stats.count += 1.0
    densify_spheres(gaussians, optimizer, spheres, stats, config, step)
    return gaussians.means.detach(), places


def test_transparent_spheres_go_and_the_largest_gradients_are_cloned():
    opacities, gradient = torch.full((40,), 0.011), torch.arange(40.0) % 13
    opacities[:10] = 0.009
    gradient[[3, 21, 30]] = torch.tensor([60.0, 50.0, 40.0])
    means, places = round_by_share(opacities, gradient, 3, clone_share=2 / 30)
    assert torch.equal(means[:30], places[10:]) and len(means) == 32
    torch.testing.assert_close(means[30:], places[[21, 30]], rtol=0.0, atol=0.1)


@pytest.mark.parametrize(("step", "left"), [(2, 300), (3, 256)])
def test_the_cap_holds_once_spheres_move(step, left):
    """A dense start may have more of them; the most opaque ones stay when warm-up ends."""
    opacities = torch.linspace(0.9, 0.1, 300)
    means, places = round_by_share(opacities, torch.zeros(300), step, warm_up=4, max_ratio=1.0, start_ratio=2.0)
    assert torch.equal(means, places[:left])


@pytest.mark.parametrize("nodes", [40, 41])
def test_no_more_spheres_than_control_points_stay_as_they_are(nodes):
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(4))
    gaussians, spheres = initial_spheres(tiny_config(), points, points, "cpu")
    before = gaussians.means.detach().clone()
    thin_spheres(gaussians, Adam(dict(gaussians.named_parameters()), RATES), spheres, nodes)
    assert torch.equal(gaussians.means, before)
