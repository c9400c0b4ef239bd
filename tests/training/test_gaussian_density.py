"""Row operations: Gaussians come and go, and their moments with them."""

from __future__ import annotations

import torch

from helpers.gaussian_rows import make, moments
from scgs_warp.gaussians import GaussianParameters
from scgs_warp.seeding import generator
from scgs_warp.training.gaussian_density import RESET_OPACITY, SPLIT_SHRINK, clone_and_split, prune, reset_opacities


def test_clones_and_halves_come_last_without_momentum(device):
    gaussians, optimizer = make(4, device)
    with torch.no_grad():
        gaussians.log_scales.copy_(torch.tensor([0.001, 0.001, 0.5, 0.5]).log()[:, None].expand(4, 3))
    before = {name: getattr(gaussians, name).detach().clone() for name in GaussianParameters.NAMES}
    first = moments(optimizer, "means")[1].clone()
    rows = torch.arange(4, device=device)
    index, fresh = clone_and_split(gaussians, optimizer, rows == 0, rows == 2, generator(0, 1))
    assert index.tolist() == [0, 1, 3, 0, 2, 2] and fresh.tolist() == [False] * 3 + [True] * 3
    for name in GaussianParameters.NAMES:
        values = getattr(gaussians, name).detach()
        assert torch.equal(values[:4], before[name][index[:4]]), name
        assert name in ("means", "log_scales") or torch.equal(values, before[name][index]), name
    halves = torch.full((2, 3), 0.5 / SPLIT_SHRINK, device=device)
    torch.testing.assert_close(gaussians.scales().detach()[4:], halves)
    assert not torch.equal(gaussians.means[4], gaussians.means[5])
    parameter, average = moments(optimizer, "means")
    assert parameter is gaussians.means
    assert torch.equal(average[:3], first[[0, 1, 3]]) and not average[3:].any()


def test_pruning_moves_moments_with_the_rows(device):
    gaussians, optimizer = make(5, device)
    means, first = gaussians.means.detach().clone(), moments(optimizer, "means")[1].clone()
    keep = torch.tensor([True, False, True, True, False], device=device)
    assert prune(gaussians, optimizer, keep).tolist() == [0, 2, 3]
    assert torch.equal(gaussians.means, means[keep]) and torch.equal(moments(optimizer, "means")[1], first[keep])


def test_pruning_everything_keeps_the_most_opaque(device):
    gaussians, optimizer = make(3, device)
    with torch.no_grad():
        gaussians.opacity_logits.copy_(torch.tensor([1.0, 3.0, float("nan")]))
    assert prune(gaussians, optimizer, torch.zeros(3, dtype=torch.bool, device=device)).tolist() == [1]
    assert len(gaussians) == 1


def test_an_opacity_reset_limits_opacities_and_forgets_their_moments(device):
    gaussians, optimizer = make(3, device)
    reset_opacities(gaussians, optimizer)
    assert float(gaussians.opacities().detach().max()) <= RESET_OPACITY + 1e-6
    assert not moments(optimizer, "opacity_logits")[1].any()


def test_halves_lie_along_the_axis_of_their_parent(device):
    """A long one along its own x, turned by 90 degrees about z: its halves differ in y."""
    gaussians, optimizer = make(1, device)
    before = gaussians.means.detach().clone()
    with torch.no_grad():
        gaussians.log_scales.copy_(torch.tensor([[1.0, 1e-4, 1e-4]]).log())
        gaussians.quats.copy_(torch.tensor([[0.5**0.5, 0.0, 0.0, 0.5**0.5]]))
    split = torch.tensor([True], device=device)
    clone_and_split(gaussians, optimizer, ~split, split, generator(0, 1))
    offsets = (gaussians.means.detach() - before).abs()
    assert float(offsets[:, [0, 2]].max()) < 1e-2 < float(offsets[:, 1].min())
