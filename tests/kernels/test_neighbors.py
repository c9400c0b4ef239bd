"""Nearest control points and RBF weights against brute force in float64."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from reference import neighbors as twin
from scgs_warp.kernels import neighbors as kernels
from scgs_warp.ops.neighbors import NeighborSearch, nearest, node_lists, rbf_weights
from scgs_warp.runtime import environment
from scgs_warp.runtime.launch import launch


def cloud(seed: int, n: int, m: int, d: int, device: str = "cpu") -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, d, generator=generator).to(device), torch.randn(m, d, generator=generator).to(device)


def assert_nearest(points, nodes, k, indices, distances):
    """The k least distances, at the indices that have them (float32 may order near-ties otherwise than float64)."""
    _, expected = twin.nearest(points.cpu(), nodes.cpu(), k)
    actual = ((points.cpu().double()[:, None] - nodes.cpu().double()[indices.cpu().long()]) ** 2).sum(-1)
    torch.testing.assert_close(actual, expected, rtol=2e-6, atol=1e-9)
    torch.testing.assert_close(distances.cpu().double(), expected, rtol=2e-6, atol=1e-9)
    assert all(len(set(row)) == k for row in indices.tolist())


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("n", "m", "d", "k"),
    [(333, 64, 3, 4), (17, 512, 3, 3), (100, 70, 11, 8), (50, 16, 3, 16), (16, 5, 3, 5), (1, 1, 3, 1), (31, 9, 1, 9),
     (40, 33, 24, 9), (40, 33, 70, 4), (64, 300, 5, 1), (333, 300, 4, 4)],
)  # fmt: skip
def test_nearest_matches_brute_force(device, seed, n, m, d, k):
    points, nodes = cloud(seed, n, m, d, device)
    assert_nearest(points, nodes, k, *nearest(points, nodes, k))


@pytest.mark.parametrize("d", [3, 4, 5])
@pytest.mark.parametrize("k", [1, 3, 4, 8, 13])
def test_plain_kernel_matches_lanes(k, d):
    points, nodes = cloud(2, 101, 64, d)
    points[::7] = nodes[:15]  # distance 0
    indices, distances = nearest(points, nodes, k)
    plain = torch.empty_like(indices), torch.empty_like(distances)
    launch(kernels.nearest, 101, points, nodes, k, *plain)
    assert torch.equal(plain[0], indices)
    torch.testing.assert_close(plain[1], distances, rtol=1e-6, atol=1e-12)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000), st.integers(1, 40), st.integers(1, 30), st.integers(1, 4))
def test_ties_go_to_the_lower_index(seed, n, m, d):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randint(-2, 3, (n, d), generator=generator).float()
    nodes = torch.randint(-2, 3, (m, d), generator=generator).float()
    k = min(m, 5)
    indices, distances = nearest(points, nodes, k)
    expected_indices, expected = twin.nearest(points, nodes, k)
    assert torch.equal(indices.long(), expected_indices)
    assert torch.equal(distances.double(), expected)
    plain = torch.empty_like(indices), torch.empty_like(distances)
    launch(kernels.nearest, n, points, nodes, k, *plain)
    assert torch.equal(plain[0], indices) and torch.equal(plain[1], distances)


def test_poisoned_points_leave_the_others_alone(device):
    points, nodes = cloud(3, 40, 20, 3, device)
    clean = nearest(points, nodes, 4)
    poisoned = points.clone()
    poisoned[3, 1], poisoned[17, 0], poisoned[18] = float("nan"), float("inf"), 3e30
    indices, distances = nearest(poisoned, nodes, 4)
    bad = torch.zeros(40, dtype=torch.bool, device=device)
    bad[[3, 17, 18]] = True
    assert torch.equal(indices[~bad], clean[0][~bad]) and torch.equal(distances[~bad], clean[1][~bad])
    assert indices.min() >= 0 and indices.max() < 20 and torch.isinf(distances[bad]).all()
    nodes[0] = float("nan")
    indices, _ = nearest(points, nodes, 4)
    assert (indices != 0).all()


def test_sizes_that_cannot_be(device):
    points, nodes = cloud(0, 5, 3, 3, device)
    for k in (0, 4, 17):
        with pytest.raises(ValueError, match="k must be"):
            nearest(points, nodes, k)
    with pytest.raises(ValueError, match="nodes"):
        nearest(points, nodes[:, :2], 1)
    with pytest.raises(ValueError, match="radii"):
        rbf_weights(points, nodes, torch.ones(2), torch.zeros(5, 1, dtype=torch.int32))
    with pytest.raises(ValueError, match="indices"):
        rbf_weights(points, nodes, torch.ones(3), torch.zeros(5, 1, dtype=torch.int64))
    indices, distances = nearest(points[:0], nodes, 2)
    assert indices.shape == (0, 2) and distances.shape == (0, 2)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("n", "m", "d", "k"),
    [(3001, 300, 3, 4), (3001, 300, 4, 4), (2000, 200, 5, 7), (1000, 100, 11, 3), (500, 3, 2, 3), (40, 20, 3, 16)],
)
def test_search_with_a_memory_is_exact_while_all_moves(device, seed, n, m, d, k):
    points, nodes = cloud(seed, n, m, d, device)
    generator = torch.Generator().manual_seed(50 + seed)
    search = NeighborSearch()
    for step in range(30):
        assert torch.equal(search(points, nodes, k), nearest(points, nodes, k)[0]), step
        size = 0.3 if step in (10, 20) else 2e-3 * step
        points = points + size * torch.randn(n, d, generator=generator).to(device)
        nodes = nodes + size * torch.randn(m, d, generator=generator).to(device)


def test_the_memory_is_used_and_renewed():
    points, nodes = cloud(7, 20_000, 300, 3)
    search = NeighborSearch()
    search(points, nodes, 4)
    lists = search.lists
    assert lists is not None and int((lists.counts >= 0).sum()) > 0.9 * len(lists.counts)
    assert float(lists.counts.float().mean()) < 100
    search(points + 1e-3, nodes + 1e-3, 4)
    assert search.lists is lists and search.full_searches < 0.01 * len(lists.counts)
    moved = nodes.flip(0)
    for _ in range(2):
        assert torch.equal(search(points, moved, 4), nearest(points, moved, 4)[0])
    assert search.full_searches > len(lists.counts) and search.lists is lists
    search(points, moved, 4)
    assert search.lists is not lists and search.full_searches == 0
    lists = search.lists
    for other in ((points[1:], nodes, 4), (points, nodes[1:], 4), (points, nodes, 3), (points[:, :2], nodes[:, :2], 3)):
        assert torch.equal(search(*other), nearest(*other)[0])
        assert search.lists is not lists
        lists = search.lists


@pytest.mark.parametrize("d", [3, 4, 11])
def test_lists_are_short_where_points_are_apart_in_any_coordinate(d):
    """Points of two kinds at the same places, apart in the last coordinate, with a few of them far out."""
    points, nodes = cloud(11, 30_000, 256, d)
    points[:, 3:], nodes[:, 3:] = 0.0, 0.0
    points[::2, -1] += 3.0
    nodes[::2, -1] += 3.0
    points[:100] *= 40.0
    search = NeighborSearch()
    search(points, nodes, 4)
    counts = search.lists.counts
    assert int((counts >= 0).sum()) > 0.9 * len(counts)
    assert float(counts[counts >= 0].float().mean()) < 50


@pytest.mark.parametrize("afar", [50.0, 1e25, float("nan"), float("inf")])
def test_one_far_jump_is_noticed(afar):
    """One node that comes from afar into the midst of all, and one point that goes elsewhere."""
    points, nodes = cloud(8, 4000, 200, 3)
    nodes[17] = afar
    search = NeighborSearch()
    search(points, nodes, 4)
    assert torch.equal(search(points, nodes, 4), nearest(points, nodes, 4)[0]) and search.full_searches == 0
    nodes[17] = 0.0
    points[9], points[10] = points[2000], 30.0
    found = search(points, nodes, 4)
    assert torch.equal(found, nearest(points, nodes, 4)[0])
    assert (found == 17).any() and search.full_searches > 1


def test_memory_and_poison():
    points, nodes = cloud(9, 600, 60, 3)
    nan, inf = float("nan"), float("inf")
    search = NeighborSearch()
    cases: list[tuple[dict[int, float], dict[int, float]]] = [
        ({}, {}), ({3: nan, 17: inf}, {}), ({3: nan, 18: 3e30}, {5: nan, 6: inf}), ({}, {5: 1e25}),
        ({4: 1e19}, {7: 2e19}), ({}, {}),
    ]  # fmt: skip
    for poisoned_points, poisoned_nodes in cases:
        own, others = points.clone(), nodes.clone()
        for tensor, values in ((own, poisoned_points), (others, poisoned_nodes)):
            for row, value in values.items():
                tensor[row, 1] = value
        for search_again in (search, NeighborSearch()):
            for _ in range(3):
                assert torch.equal(search_again(own, others, 4), nearest(own, others, 4)[0])
    everything = torch.full_like(points, nan)
    for _ in range(2):
        assert torch.equal(search(everything, nodes, 4), nearest(everything, nodes, 4)[0])
    assert search(points[:0], nodes, 4).shape == (0, 4)


@settings(deadline=None, max_examples=40)
@given(
    st.integers(0, 10_000),
    st.integers(1, 120),
    st.integers(1, 40),
    st.integers(1, 4),
    st.sampled_from([0.0, 0.1, 0.5, 1.0]),
)
def test_memory_keeps_ties(seed, n, m, d, moving):
    """Points and nodes on a grid, many of them twice; some jump to another cell of it."""
    generator = torch.Generator().manual_seed(seed)

    def grid(count):
        return torch.randint(-3, 4, (count, d), generator=generator).float()

    points, nodes, k = grid(n), grid(m), min(m, 5)
    search = NeighborSearch()
    for _ in range(4):
        assert torch.equal(search(points, nodes, k), twin.nearest(points, nodes, k)[0].int())
        points = torch.where(torch.rand(n, 1, generator=generator) < moving, grid(n), points)
        nodes = torch.where(torch.rand(m, 1, generator=generator) < 0.2 * moving, grid(m), nodes)


def weights_inputs(seed, n, m, d, k, device):
    generator = torch.Generator().manual_seed(seed)
    points, nodes = cloud(seed, n, m, d, device)
    radii = (0.3 + torch.rand(m, generator=generator)).to(device)
    strengths = (0.05 + torch.rand(m, generator=generator)).to(device)
    return points, nodes, radii, strengths, nearest(points, nodes, k)[0]


def gradients(function, tensors, indices, v):
    leaves = [tensor.detach().clone().requires_grad_() for tensor in tensors]
    weights = function(*leaves[:3], indices, *leaves[3:])
    weights.backward(v.to(weights))
    return weights.detach(), [leaf.grad for leaf in leaves]


@pytest.mark.parametrize("strong", [False, True])
@pytest.mark.parametrize(("n", "m", "d", "k"), [(333, 40, 3, 4), (5000, 64, 11, 3), (1, 1, 3, 1), (50, 6, 5, 6)])
def test_weights_and_gradients(device, n, m, d, k, strong):
    *tensors, indices = weights_inputs(4, n, m, d, k, device)
    tensors = tensors if strong else tensors[:3]
    v = torch.randn(n, k, generator=torch.Generator().manual_seed(9))
    weights, actual = gradients(rbf_weights, tensors, indices, v)
    expected_weights, expected = gradients(
        twin.rbf_weights, [t.detach().cpu().double() for t in tensors], indices.cpu(), v
    )
    torch.testing.assert_close(weights.cpu().double(), expected_weights, rtol=2e-5, atol=1e-7)
    torch.testing.assert_close(weights.sum(1), torch.ones_like(weights[:, 0]))
    for a, e in zip(actual, expected):
        torch.testing.assert_close(a.cpu().double(), e, rtol=1e-4, atol=2e-5 * float(e.abs().max()) + 1e-12)
    if n > 1:
        assert all(float(e.abs().max()) > 1e-3 for e in expected)


def test_node_gradients_by_lists_and_by_chunks():
    *tensors, indices = weights_inputs(5, 9000, 50, 3, 4, "cpu")
    v = torch.randn(9000, 4, generator=torch.Generator().manual_seed(1))
    by_chunks = gradients(rbf_weights, tensors, indices, v)[1]
    lists = node_lists(indices, 50)
    by_lists = gradients(lambda *a: rbf_weights(*a, lists=lists), tensors, indices, v)[1]
    for a, b in zip(by_chunks, by_lists):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))


def test_same_bits_for_any_number_of_threads(all_threads):
    *tensors, indices = weights_inputs(6, 20_001, 512, 3, 4, "cpu")
    v = torch.randn(20_001, 4, generator=torch.Generator().manual_seed(1))
    results = []
    for threads in (1, 2, 3):
        environment.configure(threads=threads)
        weights, grads = gradients(rbf_weights, tensors, indices, v)
        search = NeighborSearch()
        searched = [search(tensors[0] + 1e-3 * step, tensors[1], 4) for step in range(3)]
        results.append([*nearest(tensors[0], tensors[1], 4), *searched, weights, *grads])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_far_tiny_and_poisoned_rows(device):
    points = torch.tensor([[50.0, 0, 0], [0, 0, 0], [float("nan"), 0, 0], [0.2, 0, 0]], device=device)
    nodes = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [1e20, 0, 0]], device=device)
    radii = torch.tensor([0.01, 0.01, 0.01], device=device)
    indices = torch.tensor([[1, 0], [0, 1], [1, 0], [2, 2]], dtype=torch.int32, device=device)
    v = torch.tensor([[1.0, -1.0], [0.3, 2.0], [1.0, 5.0], [1.0, 2.0]])
    tensors = [points, nodes, radii, torch.tensor([0.5, 0.9, 0.0], device=device)]
    weights, grads = gradients(rbf_weights, tensors, indices, v)
    assert weights.isfinite().all()
    assert weights[0, 0] == 1.0, "far from every node the nearer one takes all"
    torch.testing.assert_close(weights.sum(1), torch.ones(4, device=device))
    assert weights[2].tolist() == [1.0, 0.0] and weights[3].tolist() == [1.0, 0.0]
    assert all(g.isfinite().all() for g in grads)


def test_strengths_that_underflow_leave_distances_to_decide(device):
    """A row whose control points all have strength 0 is shared by distance, not given to the first one."""
    points = torch.tensor([[0.6, 0.0, 0.0]], device=device)
    nodes = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], device=device)
    indices = torch.tensor([[0, 1]], dtype=torch.int32, device=device)
    v = torch.tensor([[1.0, 0.0]])
    plain = rbf_weights(points, nodes, torch.ones(2, device=device), indices)
    for strengths in (torch.zeros(2), torch.full((2,), 1e-38), torch.full((2,), 1e-20)):
        tensors = [points, nodes, torch.ones(2, device=device), strengths.to(device)]
        weights, grads = gradients(rbf_weights, tensors, indices, v)
        torch.testing.assert_close(weights, plain)
        assert all(g.isfinite().all() for g in grads) and float(grads[0].abs().max()) > 0.1
