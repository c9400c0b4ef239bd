"""ARAP rotations and energy against torch's SVD in float64, and the laws of rigid motion."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import normalize

from reference import arap as twin
from reference.neighbors import nearest
from reference.skinning import matrix
from scgs_warp.ops.arap import arap_energy, local_rotations, reverse_edges, trajectory_graph
from scgs_warp.runtime import environment


def graph(seed: int, m: int, j: int):
    """rest, posed, neighbors with some -1, weights."""
    generator = torch.Generator().manual_seed(seed)
    rest = torch.randn(m, 3, generator=generator)
    posed = rest @ matrix(normalize(torch.randn(4, generator=generator), dim=0)).T
    posed = posed + 0.2 * torch.randn(m, 3, generator=generator)
    neighbors = nearest(rest, rest, j + 1)[0][:, 1:].int().contiguous()
    neighbors[torch.rand(m, j, generator=generator) < 0.15] = -1
    return rest, posed, neighbors, torch.rand(m, j, generator=generator)


def assert_rotations(R: torch.Tensor) -> None:
    R = R.cpu().double()
    torch.testing.assert_close(R @ R.mT, torch.eye(3, dtype=R.dtype).expand_as(R), rtol=0, atol=1e-6)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(R), dtype=R.dtype), rtol=0, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("m", "j"), [(60, 8), (33, 5), (200, 10)])
def test_energy_and_gradients(device, seed, m, j):
    rest, posed, neighbors, weights = graph(seed, m, j)
    v = torch.randn(m, generator=torch.Generator().manual_seed(seed))
    leaves = [t.to(device).detach().requires_grad_() for t in (rest.clone(), posed.clone())]
    energy = arap_energy(*leaves, neighbors.to(device), weights.to(device))
    energy.backward(v.to(device))
    doubles = [t.double().requires_grad_() for t in (rest, posed)]
    expected = twin.arap_energy(*doubles, neighbors, weights.double())
    expected.backward(v.double())
    torch.testing.assert_close(energy.detach().cpu().double(), expected.detach(), rtol=1e-4, atol=1e-5)
    for a, e in zip(leaves, doubles):
        torch.testing.assert_close(a.grad.cpu().double(), e.grad, rtol=1e-4, atol=1e-4)
        assert float(e.grad.abs().max()) > 0.1


@pytest.mark.parametrize("seed", [0, 1])
def test_rotations_match_the_svd(device, seed):
    rest, posed, neighbors, weights = graph(seed, 100, 10)
    R = local_rotations(rest.to(device), posed.to(device), neighbors.to(device), weights.to(device))
    assert_rotations(R)
    # where the optimum is well determined; elsewhere the energy test above is the judge
    expected = twin.local_rotations(rest.double(), posed.double(), neighbors, weights.double())
    close = ((R.cpu().double() - expected).abs().amax((1, 2)) < 1e-4).double().mean()
    assert close > 0.97, float(close)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rigid_motion_costs_nothing(device, seed):
    rest, _, neighbors, weights = graph(seed, 80, 8)
    generator = torch.Generator().manual_seed(seed)
    Q = matrix(normalize(torch.randn(4, generator=generator), dim=0))
    posed = rest @ Q.T + torch.randn(3, generator=generator)
    tensors = rest.to(device), posed.to(device), neighbors.to(device), weights.to(device)
    assert float(arap_energy(*tensors).max()) < 1e-9
    edges = (neighbors >= 0).sum(1) >= 3
    R = local_rotations(*tensors).cpu()[edges]
    torch.testing.assert_close(R, Q.expand_as(R), rtol=0, atol=2e-5)
    assert float(arap_energy(tensors[0], 1.5 * tensors[1], *tensors[2:]).min()) > 1e-4, "stretching does cost"


def test_reflections_do_not_pass_for_rotations(device):
    rest, _, neighbors, weights = graph(0, 50, 8)
    mirror = rest * torch.tensor([1.0, 1.0, -1.0])
    R = local_rotations(rest.to(device), mirror.to(device), neighbors.to(device), weights.to(device))
    assert_rotations(R)


def star(edges_rest, edges_posed, device):
    """One node at the origin with the given edges; the others have none."""
    rest = torch.tensor([[0.0, 0, 0], *edges_rest], device=device)
    posed = torch.tensor([[0.0, 0, 0], *edges_posed], device=device)
    neighbors = torch.full((len(rest), len(edges_rest)), -1, dtype=torch.int32, device=device)
    neighbors[0] = torch.arange(1, len(rest), dtype=torch.int32, device=device)
    return rest, posed, neighbors, torch.ones(neighbors.shape, device=device)


@pytest.mark.parametrize("scale", [1e-12, 1e-3, 1.0, 1e6])
@pytest.mark.parametrize(
    ("rest", "posed"),
    [
        ([[1.0, 0, 0], [2.0, 0, 0]], [[0.0, 1, 0], [0, 2.0, 0]]),  # collinear
        ([[1.0, 0, 0], [2.0, 0, 0]], [[-1.0, 0, 0], [-2.0, 0, 0]]),  # turned about by 180 degrees
        ([[1.0, 0, 0], [0, 1.0, 0]], [[1.0, 0, 0], [0, -1.0, 0]]),  # planar, mirrored
        ([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]], [[-1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]]),  # point mirrored
        ([[0.0, 0, 0], [0, 0, 0]], [[1.0, 0, 0], [0, 1.0, 0]]),  # zero edges
        ([[1.0, 2, 3]], [[3.0, 2, 1]]),  # a single edge
        ([[1.0, 0, 0], [1.0, 1e-7, 0]], [[1.0, 0, 0], [1.0, 1e-7, 0]]),
    ],
)
def test_degenerate_neighborhoods_have_rotations(device, rest, posed, scale):
    scaled = ([[scale * x for x in edge] for edge in edges] for edges in (rest, posed))
    tensors = star(*scaled, device)
    R = local_rotations(*tensors)
    assert_rotations(R)
    identity = torch.eye(3, device=device)
    assert all(torch.equal(r, identity) for r in R[1:]), "no neighbours: the identity"
    energy = arap_energy(*tensors)
    rest, posed, neighbors, weights = (tensor.cpu() for tensor in tensors)
    expected = twin.arap_energy(rest.double(), posed.double(), neighbors, weights.double())
    torch.testing.assert_close(energy.cpu().double(), expected, rtol=1e-4, atol=1e-5 * scale**2)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000))
def test_always_a_rotation_and_never_worse_than_the_identity(seed):
    generator = torch.Generator().manual_seed(seed)
    # small integers: many rank-deficient and mirrored neighbourhoods
    rest, posed = (torch.randint(-1, 2, (30, 3), generator=generator).float() for _ in range(2))
    neighbors = torch.randint(-1, 30, (30, 4), generator=generator).int()
    weights = torch.randint(0, 2, (30, 4), generator=generator).float()
    assert_rotations(local_rotations(rest, posed, neighbors, weights))
    expected = twin.arap_energy(rest.double(), posed.double(), neighbors, weights.double())
    torch.testing.assert_close(arap_energy(rest, posed, neighbors, weights).double(), expected, rtol=1e-4, atol=1e-4)


def test_poison_gives_valid_rotations(device):
    rest, posed, neighbors, weights = graph(0, 20, 4)
    posed[3, 1] = float("nan")
    R = local_rotations(rest.to(device), posed.to(device), neighbors.to(device), weights.to(device))
    assert_rotations(R)


def test_empty_and_lonely_nodes_have_no_energy_and_wrong_arguments_are_refused(device):
    empty = torch.zeros(0, 3, device=device)
    none = torch.zeros(0, 4, dtype=torch.int32, device=device)
    assert arap_energy(empty, empty, none, torch.zeros(0, 4, device=device)).shape == (0,)
    one = torch.ones(1, 3, device=device, requires_grad=True)
    alone = torch.full((1, 2), -1, dtype=torch.int32, device=device)
    energy = arap_energy(one, one.detach(), alone, torch.ones(1, 2, device=device))
    energy.sum().backward()
    assert energy.tolist() == [0.0] and not one.grad.any()
    with pytest.raises(ValueError, match="neighbors"):
        arap_energy(one, one, alone.long(), torch.ones(1, 2, device=device))
    with pytest.raises(ValueError, match="weights"):
        arap_energy(one, one, alone, torch.ones(1, 3, device=device))


def test_same_bits_for_any_number_of_threads_and_with_given_lists(all_threads):
    rest, posed, neighbors, weights = graph(3, 700, 8)
    results = []
    for threads, reverse in ((1, None), (2, None), (2, reverse_edges(neighbors))):
        environment.configure(threads=threads)
        leaves = [t.clone().requires_grad_() for t in (rest, posed)]
        energy = arap_energy(*leaves, neighbors, weights, reverse=reverse)
        energy.backward(torch.ones(700))
        results.append([energy.detach(), leaves[0].grad, leaves[1].grad])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


@pytest.mark.parametrize(("times", "nodes", "count"), [(8, 60, 8), (1, 20, 3), (16, 300, 15), (4, 9, 8)])
def test_the_trajectory_graph_is_that_of_the_reference(device, times, nodes, count):
    trajectories = torch.randn(times, nodes, 3, generator=torch.Generator().manual_seed(times))
    neighbors, weights = trajectory_graph(trajectories.to(device), count)
    expected, expected_weights = twin.trajectory_graph(trajectories, count)
    assert neighbors.dtype == torch.int32 and torch.equal(neighbors.cpu().long(), expected)
    torch.testing.assert_close(weights.cpu().double(), expected_weights, rtol=1e-4, atol=1e-6)


def test_trajectory_graph_of_few_or_equal_nodes(device):
    neighbors, weights = trajectory_graph(torch.randn(2, 3, 3, device=device), 5)
    assert (neighbors[:, 2:] == -1).all() and not weights[:, 2:].any() and (neighbors[:, :2] >= 0).all()
    neighbors, weights = trajectory_graph(torch.zeros(2, 20, 3, device=device), 4)
    own = torch.arange(20, device=device)[:, None]
    assert (neighbors != own).all() and (neighbors >= 0).all()
    torch.testing.assert_close(weights, torch.full_like(weights, 0.25))
    neighbors, weights = trajectory_graph(torch.zeros(2, 1, 3, device=device), 4)
    assert (neighbors == -1).all() and not weights.any()
    with pytest.raises(ValueError, match="count"):
        trajectory_graph(torch.zeros(2, 4, 3), 16)


def test_trajectory_graph_ignores_nodes_that_are_not_finite(device):
    trajectories = torch.randn(3, 12, 3, device=device)
    trajectories[1, 4] = float("nan")
    neighbors, weights = trajectory_graph(trajectories, 5)
    assert weights.isfinite().all() and (neighbors[weights > 0] != 4).all()
    assert (neighbors[4] == -1).all() and not weights[4].any()
