"""Evaluations of one network at the same positions share the sums over the positions' inputs."""

from __future__ import annotations

import pytest
import torch

from helpers.networks import parameters, rows
from scgs_warp.motion.network import DeformationNetwork
from scgs_warp.ops import network as ops
from scgs_warp.ops import network_cache
from scgs_warp.ops.network import Layers, evaluate
from scgs_warp.ops.network_cache import NetworkCache

SHAPES = [  # inputs of position and time, hidden widths, layers that read the inputs again, outputs
    (63, 13, [256] * 8, {4}, 7),
    (30, 2, [64, 32, 96], {1, 2}, 40),
    (32, 1, [32], set(), 33),
    (64, 13, [32, 32], {1}, 3),
]


@pytest.fixture(autouse=True)
def without_tiles(monkeypatch):
    """Tiles sum in another order."""
    monkeypatch.setattr(ops, "pair_products", lambda: 1)


def moving_network(seed: int) -> DeformationNetwork:
    random = torch.Generator().manual_seed(seed)
    model = DeformationNetwork({"translations": 3}, generator=random).eval()
    torch.nn.init.normal_(model.head.weight, std=0.05, generator=random)
    return model


@torch.no_grad()
@pytest.mark.parametrize("positions", [1, 8, 13, 70])
@pytest.mark.parametrize("shape", SHAPES)
def test_sums_over_positions_change_no_bit(shape, positions):
    weights, biases = parameters(shape, 41)
    where, when = rows(shape, positions, 3, 41)
    layers = Layers(weights, biases, shape[0] + shape[1])
    order = torch.randperm(positions, generator=torch.Generator().manual_seed(41)).int()
    sums = layers.position_sums(where, order)
    for time in when.split(1):
        assert torch.equal(layers.values_at(sums, time), evaluate(layers, where, time))


@torch.no_grad()
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_position_that_is_not_finite_spoils_its_own_row_alone(bad):
    model, random = moving_network(42), torch.Generator().manual_seed(42)
    positions, time = torch.randn(40, 3, generator=random), torch.tensor([0.3])
    clean = model(positions, time)["translations"][0]
    positions[5, 1] = bad
    found = model(positions, time)["translations"][0]
    kept = torch.arange(40) != 5
    assert bool(found[5].isnan().any()) and torch.equal(found[kept], clean[kept])


@torch.no_grad()
def test_one_time_and_several_give_the_same_bits():
    model, random = moving_network(43), torch.Generator().manual_seed(43)
    positions, times = torch.randn(77, 3, generator=random), torch.rand(4, generator=random)
    whole = model(positions, times)["translations"]
    for own, time in zip(whole, times.split(1), strict=True):
        assert torch.equal(model(positions, time)["translations"][0], own)


def counted(monkeypatch) -> list[int]:
    """Return a list that gets an entry for every computation of sums."""
    made: list[int] = []
    original = Layers.position_sums
    monkeypatch.setattr(
        Layers, "position_sums", lambda self, where, order: made.append(len(where)) or original(self, where, order)
    )
    return made


@torch.no_grad()
def test_sums_are_made_once_and_anew_when_positions_or_weights_change(monkeypatch):
    made, model = counted(monkeypatch), moving_network(44)
    positions = torch.randn(20, 3, generator=torch.Generator().manual_seed(44))

    def check(expected: int) -> None:
        for time in (torch.tensor([0.2]), torch.tensor([0.9])):
            found = model(positions, time)["translations"]
            assert torch.equal(found, model(positions, time.repeat(2))["translations"][:1])
        assert len(made) == expected

    check(1)
    positions.add_(0.1)  # counted by torch
    check(2)
    positions = positions.clone()
    check(3)
    positions = positions[3:]
    check(4)
    positions = positions[:9]
    check(5)
    model.layers[0].bias.add_(0.1)
    check(6)
    model.train()
    model.layers[4].weight.numpy()[:] *= 1.1  # not counted, as an optimiser's kernel writes
    model.eval()
    check(7)
    model(positions.detach(), torch.tensor([0.5]))
    assert len(made) == 7, "another view of the same positions is not another set of positions"


@torch.no_grad()
def test_positions_at_an_address_that_was_freed_are_other_positions(monkeypatch):
    made, model = counted(monkeypatch), moving_network(45)
    for seed in range(20):
        positions = torch.randn(16, 3, generator=torch.Generator().manual_seed(seed))
        found = model(positions, torch.tensor([0.4]))["translations"][0]
        assert torch.equal(found, model(positions, torch.tensor([0.4, 0.4]))["translations"][1])
        del positions
    assert len(made) == 20


def test_positions_whose_changes_torch_does_not_count_are_not_kept(monkeypatch):
    made, model = counted(monkeypatch), moving_network(46)
    with torch.inference_mode():
        positions = torch.randn(9, 3)
        first = model(positions, torch.tensor([0.3]))["translations"]
        positions.add_(0.5)
        assert not torch.equal(model(positions, torch.tensor([0.3]))["translations"], first)
    assert made == []


@torch.no_grad()
def test_no_positions_and_many_positions_need_no_sums(monkeypatch):
    made, model = counted(monkeypatch), moving_network(47)
    assert model(torch.zeros(0, 3), torch.tensor([0.3]))["translations"].shape == (1, 0, 3)
    many = torch.randn(ops.ROWS_AT_ONCE + 1, 3, generator=torch.Generator().manual_seed(47))
    found = model(many, torch.tensor([0.3]))["translations"][0]
    assert made == []
    assert torch.equal(model(many[:50].clone(), torch.tensor([0.3]))["translations"][0], found[:50])


@torch.no_grad()
def test_neighbours_in_space_share_a_tile():
    """Points along a line, shuffled, come back in the order of the line."""
    shuffled = torch.randperm(64, generator=torch.Generator().manual_seed(48))
    positions = (shuffled.float() / 63.0)[:, None].expand(64, 3).contiguous()
    order = network_cache._along_a_curve(positions)
    assert torch.equal(shuffled[order.long()], torch.arange(64))


@torch.no_grad()
def test_a_cache_that_forgets_makes_everything_anew(monkeypatch):
    made = counted(monkeypatch)
    weights, biases = parameters(SHAPES[0], 49)
    cache, positions = NetworkCache(), torch.randn(9, 63)
    packed: list[Layers] = []

    def use() -> None:
        layers = cache.layers((*weights, *biases), lambda: Layers(weights, biases, 76))
        packed.append(layers)
        cache.position_sums(layers, positions, lambda p: p)

    use()
    use()
    assert packed[0] is packed[1] and len(made) == 1
    cache.forget()
    use()
    assert packed[2] is not packed[0] and len(made) == 2
