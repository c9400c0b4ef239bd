"""ARAP: its weight as a function of the step, its instants, its energy."""

from __future__ import annotations

import math

import pytest
import torch

from scgs_warp.config.fields import LossConfig
from scgs_warp.motion.rigidity import arap_times, arap_weight, build_graph, rigidity
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


def test_the_energy_is_between_the_last_two_instants():
    """The first of three is the view's own; the regulariser has drawn the others."""
    rest = torch.rand(20, 3, generator=torch.Generator().manual_seed(0))
    graph = build_graph(lambda times: rest.expand(len(times), -1, -1), LossConfig(arap_neighbors=6))
    assert graph is not None
    bent = rest * torch.tensor([1.5, 1.0, 1.0])
    assert float(rigidity([bent, rest, rest + 0.5], graph)) < 1e-6
    assert torch.equal(rigidity([rest + 0.5, rest, bent], graph), rigidity([rest, bent], graph))
