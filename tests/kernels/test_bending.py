"""Bending of Gaussians against float64, and the laws that it keeps."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from reference.bending import bend as twin
from scgs_warp.edit.rotations import from_axis, rotate, to_matrix
from scgs_warp.ops.bending import NodeBend, bend


def scene(seed: int, n: int = 200, m: int = 12, k: int = 4):
    """Random Gaussians, bend and binding; some weights are 0."""
    generator = torch.Generator().manual_seed(seed)
    means, nodes = (torch.randn(count, 3, generator=generator) for count in (n, m))
    quats = torch.randn(n, 4, generator=generator)
    scales = 0.01 + 0.2 * torch.rand(n, 3, generator=generator)
    turns = normalize(torch.randn(m, 4, generator=generator), dim=1)
    stretches = torch.eye(3) + 0.4 * torch.randn(m, 3, 3, generator=generator)
    stretches = 0.5 * (stretches + stretches.mT)
    shifts, moved = torch.randn(m, 3, generator=generator), torch.ones(m, dtype=torch.int32)
    indices = torch.stack([torch.randperm(m, generator=generator)[:k] for _ in range(n)]).int()
    weights = torch.rand(n, k, generator=generator)
    weights[torch.rand(n, k, generator=generator) < 0.3] = 0.0
    weights[:, 1] += 0.1
    weights /= weights.sum(1, keepdim=True)
    return (means, quats, scales), NodeBend(nodes, shifts, turns, stretches, moved), (indices, weights)


def on(device: str, *groups):
    return [type(g)(*(x.to(device) for x in g)) if hasattr(g, "_fields") else [x.to(device) for x in g] for g in groups]


@pytest.mark.parametrize("dual", [False, True])
@pytest.mark.parametrize("widest", [1.0, 1.8])
@pytest.mark.parametrize("seed", [0, 1])
def test_values(seed, dual, widest, device):
    gaussians, by, binding = scene(seed)
    moved, of_nodes, bound = on(device, gaussians, by, binding)
    found = bend(*moved, of_nodes, *bound, dual=dual, widest=widest)
    for i in range(len(gaussians[0])):
        own = binding[0][i].long()
        picked = [x[own].double().numpy() for x in by[:4]]
        mean, covariance, turn = twin(
            *(x[i].double().numpy() for x in gaussians), *picked, binding[1][i].double().numpy(), dual, widest
        )
        np.testing.assert_allclose(found.means[i].cpu().numpy(), mean, atol=3e-5)
        assert abs(abs(float(found.blends[i].cpu().double().numpy() @ turn)) - 1.0) < 1e-5
        axes = to_matrix(found.quats[i].cpu().double().numpy()) @ np.diag(found.scales[i].cpu().double().numpy())
        np.testing.assert_allclose(axes @ axes.T, covariance, atol=2e-5)


@pytest.mark.parametrize("dual", [False, True])
def test_a_common_motion_is_rigid(dual, device):
    gaussians, by, binding = scene(3)
    turn, shift = from_axis((0.2, -1.0, 0.5), 110), np.array([0.3, -0.2, 0.9])
    nodes = by.nodes.double().numpy()
    shifts = torch.from_numpy(rotate(turn, nodes) + shift - nodes).float()
    turns = torch.from_numpy(turn).float().repeat(len(nodes), 1)
    by = by._replace(shifts=shifts, turns=turns, stretches=torch.eye(3).repeat(len(nodes), 1, 1))
    moved, of_nodes, bound = on(device, gaussians, by, binding)
    found = bend(*moved, of_nodes, *bound, dual=dual, widest=2.0)
    wanted = rotate(turn, gaussians[0].double().numpy()) + shift
    np.testing.assert_allclose(found.means.cpu().numpy(), wanted, atol=2e-5)
    assert found.scales.cpu().equal(gaussians[2]), "nothing stretches"


def test_dual_quaternions_keep_the_distance_from_a_common_axis(device):
    """Half way between a control point that stays and one that turns by 150 degrees about the same axis, the linear
    blend collapses to the axis."""
    means = torch.tensor([[0.0, 1.0, 0.0]])
    turns = torch.from_numpy(np.stack([from_axis((1, 0, 0), degrees) for degrees in (0, 150)])).float()
    none, still = torch.zeros(2, 3), torch.eye(3).repeat(2, 1, 1)
    by = NodeBend(none, none, turns, still, torch.ones(2, dtype=torch.int32))
    rest = [means, torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1, 3)]
    moved, of_nodes, bound = on(device, rest, by, [torch.tensor([[0, 1]]).int(), torch.tensor([[0.5, 0.5]])])
    away = [float(bend(*moved, of_nodes, *bound, dual=dual).means.norm()) for dual in (False, True)]
    assert away[0] < 0.3 and away[1] == pytest.approx(1.0, abs=1e-5)


def test_what_no_control_point_moves_keeps_its_bits(device):
    gaussians, by, (indices, weights) = scene(5)
    by.moved[:] = 0
    by.moved[3] = 1
    bound = (indices == 3) & (weights > 0)
    moved, of_nodes, binding = on(device, gaussians, by, (indices, weights))
    found = bend(*moved, of_nodes, *binding, widest=2.0)
    still = ~bound.any(1)
    assert 20 < int(still.sum()) < 190
    for now, before in zip(found[:3], gaussians):
        assert now.cpu()[still].equal(before[still])
    assert not found.means.cpu()[~still].equal(gaussians[0][~still])
    assert (found.blends.cpu()[still] == torch.tensor([1.0, 0, 0, 0])).all()


@pytest.mark.parametrize(("stretch", "sheared"), [(0.008, 0.0), (0.02, 0.0), (0.0, 0.008), (0.0, 0.02)])
def test_only_a_stretch_of_more_than_a_hundredth_widens(stretch, sheared, device):
    """Also one along a diagonal, which shows in no entry of the matrix's own diagonal."""
    own = torch.eye(3)
    own[0, 0] += stretch
    own[1, 2] = own[2, 1] = sheared
    gaussians, by, binding = scene(6)
    by = by._replace(stretches=own.repeat(len(by.nodes), 1, 1), turns=by.turns[:1].repeat(len(by.nodes), 1))
    moved, of_nodes, bound = on(device, gaussians, by, binding)
    scales = bend(*moved, of_nodes, *bound, widest=2.0).scales.cpu()
    if max(stretch, sheared) < 0.01:
        assert scales.equal(gaussians[2])
    else:
        grown = scales.prod(1) / gaussians[2].prod(1)
        assert ((grown - (1.0 + max(stretch, sheared))).abs() < 1e-4).all()


def test_wrong_shapes_are_refused():
    gaussians, by, binding = scene(0)
    with pytest.raises(ValueError, match=r"turns must be \[12, 4\]"):
        bend(*gaussians, by._replace(turns=by.turns[:, :3]), *binding)
