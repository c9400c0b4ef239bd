"""ARAP: its weight as a function of the step, its instants, its energy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from scgs_warp.config.fields import LossConfig
from scgs_warp.motion.rigidity import (
    STRETCHED,
    arap_times,
    arap_weight,
    build_graph,
    momentary_graph,
    rigidity,
    spared,
    tearing,
)
from scgs_warp.ops.arap import trajectory_graph
from scgs_warp.seeding import generator


@pytest.mark.parametrize(
    "step, weight",
    [
        (0, 5e-2),
        (1, 0.0),
        (4, 0.0),
        (5, 5e-2 * 10 ** (-5 / 50)),
        (25, 5e-2 * 10**-0.5),
        (45, 5e-2 * 10**-0.9),
        (50, 0.0),
    ],
)
def test_weight_decays_and_is_carried_by_every_fifth_step(step, weight):
    loss = LossConfig(arap=1e-2, arap_end=1e-3, arap_until=50, arap_every=5)
    assert arap_weight(step, loss) == pytest.approx(weight)
    assert arap_weight(step, LossConfig(arap=0.0)) == 0.0


@pytest.mark.parametrize("pair, count", [("frame", 1), ("random", 2)])
def test_instants_come_from_the_generator(pair, count):
    loss = LossConfig(arap_pair=pair)
    times = arap_times(loss, generator(0, 1))
    assert len(times) == count and all(0.0 <= time < 1.0 for time in times)
    assert times == arap_times(loss, generator(0, 1)) != arap_times(loss, generator(0, 2))


def test_only_bending_costs_energy(device):
    rest = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)).to(device)
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], device=device)
    graph = build_graph(lambda times: rest.expand(len(times), -1, -1), LossConfig(arap_neighbors=6))
    assert graph is not None and graph.neighbors.shape == (20, 6)
    torch.testing.assert_close(graph.weights.sum(1), torch.ones(20, device=device))
    assert float(rigidity([rest, rest @ turn.T + 0.5], graph)) < 1e-6
    bent = rest * torch.tensor([1.5, 1.0, 1.0], device=device)
    energy = float(rigidity([rest, bent], graph))
    assert energy > 1e-3 and math.isfinite(energy)


def test_no_graph_of_one_control_point():
    assert build_graph(lambda times: torch.zeros(len(times), 1, 3), LossConfig()) is None
    assert momentary_graph(torch.zeros(2, 1, 3), LossConfig()) is None


def crossing_rods(device):
    """Two rods of 8 points side by side, whose lower halves change places at the second instant."""
    height = torch.arange(8, device=device) * 0.1
    rods = torch.stack([torch.stack([torch.full_like(height, x), height, 0 * height], 1) for x in (0.0, 1.0)])
    swapped = torch.stack([torch.cat([rods[1 - i, :4], rods[i, 4:]]) for i in (0, 1)])
    return rods.reshape(-1, 3), swapped.reshape(-1, 3)


def test_neighbors_of_a_moment_join_what_an_exchange_separates(device):
    first, second = crossing_rods(device)
    loss = LossConfig(arap_neighbors=2)
    edges = [(3, 4), (4, 3), (11, 12), (12, 11)]

    def joined(graph):
        assert graph is not None
        return [second in graph.neighbors[first].tolist() for first, second in edges]

    assert all(joined(momentary_graph(torch.stack([first, second]), loss)))
    tracks = torch.stack([first, second])
    assert not any(joined(build_graph(lambda times: tracks[(times > 0.5).long()], loss)))


def test_edges_that_change_their_length_count_less(device):
    first, second = crossing_rods(device)
    loss = LossConfig(arap_neighbors=2)
    kept = momentary_graph(torch.stack([first, first + 0.5]), loss)
    parted = momentary_graph(torch.stack([first, second]), loss)
    assert kept is not None and parted is not None
    torch.testing.assert_close(kept.weights.sum(1), torch.ones(16, device=device))
    assert torch.equal(kept.neighbors, parted.neighbors)
    share = parted.weights / kept.weights
    change = math.sqrt(1.0 + 0.1**2) - 0.1  # the lower end goes over to the other rod
    weight = (1.0 + (change / (2.0 * 0.1)) ** 2) ** -2
    crossing = parted.neighbors[3].tolist().index(4)
    assert float(share[3, crossing]) == pytest.approx(weight, rel=1e-4) and weight < 0.01
    assert float(share[6].min()) == pytest.approx(1.0)


def test_a_graph_of_a_moment_replaces_the_one_before_in_place(device):
    first, second = crossing_rods(device)
    loss = LossConfig(arap_neighbors=2)
    graph = momentary_graph(torch.stack([first, first]), loss)
    assert graph is not None
    expected = momentary_graph(torch.stack([first, second]), loss)
    assert momentary_graph(torch.stack([first, second]), loss, graph) is graph
    assert expected is not None and torch.equal(graph.weights, expected.weights)


def test_points_that_are_not_finite_have_no_weight(device):
    first, second = crossing_rods(device)
    second = second.clone()
    second[5] = math.nan
    graph = momentary_graph(torch.stack([first, second]), LossConfig(arap_neighbors=2))
    assert graph is not None and bool(graph.weights.isfinite().all())
    assert float(graph.weights[5].sum()) == 0.0


def test_the_energy_is_between_the_last_two_instants():
    """The first of three is the view's own; the regulariser has drawn the others."""
    rest = torch.rand(20, 3, generator=torch.Generator().manual_seed(0))
    graph = build_graph(lambda times: rest.expand(len(times), -1, -1), LossConfig(arap_neighbors=6))
    assert graph is not None
    bent = rest * torch.tensor([1.5, 1.0, 1.0])
    assert float(rigidity([bent, rest, rest + 0.5], graph)) < 1e-6
    assert torch.equal(rigidity([rest + 0.5, rest, bent], graph), rigidity([rest, bent], graph))


def spared_in_float64(instants, neighbors, weights, slack):
    """The weights of ``spared``, by numpy's SVD, edge by edge."""
    instants, weights = instants.double().cpu().numpy(), weights.double().cpu().numpy()
    neighbors = neighbors.cpu().numpy()
    count, nodes = instants.shape[:2]
    nearest = [np.linalg.norm(instant[neighbors[:, 0]] - instant, axis=1) for instant in instants]
    unit = np.sort(np.concatenate(nearest))[(count * nodes - 1) // 2]
    pairs = [(first, (first + apart) % count) for apart in (1, 2, 4) for first in range(count)]
    share = np.ones_like(weights)
    for _ in range(2):
        total = np.zeros_like(weights)
        for first, second in pairs:
            for node in range(nodes):
                edges = instants[first, neighbors[node]] - instants[first, node]
                posed = instants[second, neighbors[node]] - instants[second, node]
                left, _, right = np.linalg.svd((posed.T * (weights * share)[node]) @ edges)
                turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
                total[node] += ((posed - edges @ turn.T) ** 2).sum(1)
        share = (1 + total / len(pairs) / (slack * unit) ** 2) ** -2
    return weights * share


def bent_bar(angles, device):
    """A bar of 2 x 2 x 10 points, whose upper half turns by ``angles`` about an axis across its middle."""
    grid = torch.meshgrid(torch.arange(2.0), torch.arange(2.0), torch.arange(10.0), indexing="ij")
    bar = torch.stack(grid, -1).reshape(-1, 3) + 0.05 * torch.rand(40, 3, generator=generator(0, 1))
    upper, joint, bent = bar[:, 2] > 4.7, torch.tensor([0.5, 0.5, 4.5]), []
    for angle in angles:
        turn = torch.tensor([[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]])
        bent.append(torch.where(upper[:, None], (bar - joint) @ turn.T + joint, bar))
    return torch.stack(bent).to(device), upper.to(device)


def test_edges_across_a_joint_count_less_than_those_of_a_limb(device):
    instants, upper = bent_bar([0.2 * step for step in range(8)], device)
    neighbors, weights = trajectory_graph(instants, 6)
    found = spared(instants, neighbors, weights, 0.5)
    expected = spared_in_float64(instants, neighbors, weights, 0.5)
    np.testing.assert_allclose(found.cpu().numpy(), expected, rtol=1e-4, atol=1e-7)
    across = upper[neighbors.long()] != upper[:, None]
    assert bool(across.any()) and float((found / weights)[across].mean()) < 0.75
    assert float((found / weights)[~across].median()) > 0.95


def test_a_rigid_motion_spares_no_edge(device):
    points = torch.rand(40, 3, generator=generator(0, 1))
    instants = torch.stack([swung(points, 0.7 * time, 0.3 * time) for time in range(8)]).to(device)
    neighbors, weights = trajectory_graph(instants, 6)
    torch.testing.assert_close(spared(instants, neighbors, weights, 0.5), weights, rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_instants_spare_what_bends_between_them(count, device):
    instants, _ = bent_bar([0.0, 1.5, 1.5][:count], device)
    neighbors, weights = trajectory_graph(instants, 6)
    least = float((spared(instants, neighbors, weights, 0.5) / weights).min())
    assert least == pytest.approx(1.0) if count == 1 else least < 0.5


def test_edges_of_points_that_are_not_finite_are_left_out(device):
    instants, _ = bent_bar([0.1 * step for step in range(8)], device)
    neighbors, weights = trajectory_graph(instants, 6)
    instants[3, 7] = math.nan
    found = spared(instants, neighbors, weights, 0.5)
    assert bool(found.isfinite().all()) and float(found[7].sum()) == 0.0
    assert float(found[neighbors == 7].abs().sum()) == 0.0 and float(found[30].sum()) > 0.5


def test_a_graph_spares_edges_only_if_asked(device):
    instants, _ = bent_bar([0.2 * step for step in range(8)], device)
    loss = LossConfig(arap_neighbors=6)
    full, less = (build_graph(lambda times: instants, loss, slack=slack) for slack in (0.0, 0.5))
    assert full is not None and less is not None and torch.equal(full.neighbors, less.neighbors)
    torch.testing.assert_close(full.weights.sum(1), torch.ones(40, device=device))
    assert torch.equal(less.weights, spared(instants, less.neighbors, full.weights, 0.5))
    assert build_graph(lambda times: instants, loss, full, 0.5) is full and torch.equal(full.weights, less.weights)


def swung(points: torch.Tensor, angle: float, shift: float) -> torch.Tensor:
    turn = torch.tensor([[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0, 0, 1]])
    return points @ turn.T + shift


def test_a_rigid_motion_tears_nothing():
    points = torch.rand(40, 3, generator=generator(0, 1))
    instants = torch.stack([swung(points, 0.7 * time, 0.3 * time) for time in range(5)])
    assert tearing(instants, 6) < 1e-6
    assert tearing(instants[:, :1], 6) == 0.0 and tearing(instants[:, :0], 6) == 0.0


def test_tearing_is_that_of_the_edges_one_after_the_other():
    random = generator(0, 2)
    instants = torch.rand(1, 12, 3, generator=random) + 0.2 * torch.randn(4, 12, 3, generator=random)
    expected = []
    for first in instants.double():
        away = torch.cdist(first, first) + 1e9 * torch.eye(12)
        spacing = away.min(1).values.median()
        shares = []
        for other in instants.double():
            for point in range(12):
                for end in away[point].argsort()[:3].tolist():
                    change = ((other[point] - other[end]).norm() - away[point, end]) / spacing
                    shares.append(float(change**2 / (change**2 + STRETCHED**2)))
        expected.append(sum(shares) / len(shares))
    assert tearing(instants, 3) == pytest.approx(sum(expected) / 4, rel=1e-5)
    assert 0.001 < tearing(instants, 3) < 1.0


def test_two_limbs_that_exchange_their_ends_are_torn_more_than_two_that_pass():
    """Legs of ten points swing past each other; with exchanged tracks, their lower halves stay behind instead."""
    hip, lengths, times = torch.tensor([0.0, 0.0, 1.0]), torch.linspace(0.0, 1.0, 10), torch.linspace(-1.0, 1.0, 9)
    legs = torch.stack([
        torch.cat([
            hip + torch.stack([side * 0.1 + 0 * lengths, lengths * math.sin(angle), -lengths * math.cos(angle)], 1)
            for side, angle in ((-1.0, 0.6 * time), (1.0, -0.6 * time))
        ])
        for time in times.tolist()
    ])  # fmt: skip
    exchanged = legs.clone()
    after = times > 0
    exchanged[after, 5:10], exchanged[after, 15:] = legs[after, 15:], legs[after, 5:10]
    assert tearing(exchanged, 4) > 2.0 * tearing(legs, 4)


def test_places_that_are_not_finite_do_not_count():
    instants = torch.rand(3, 40, 3, generator=generator(0, 3))
    expected = tearing(torch.cat([instants[:, :3], instants[:, 4:]], 1), 6)
    assert expected > 0.01
    instants[1, 3, 2] = float("nan")
    assert tearing(instants, 6) == pytest.approx(expected)
    instants[0] = float("inf")
    assert tearing(instants, 6) == 0.0
