"""Binning that never waits for the device: the lists of ``bin_splats``, room to spare or too little of it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.binning_cuda import bin_within
from scgs_warp.ops.compositing import composite
from scgs_warp.types import Splats

from helpers.splats import random_splats  # isort: skip


def some_splats(seed: int, device: str) -> Splats:
    """Equal, negative and zero depths among them, and a splat that is culled."""
    splats = random_splats(seed, 300, 90, 70, device)
    depths = torch.round(4 * splats.depths) / 4 - 2.0
    depths = torch.where(depths == 0, -depths, depths)
    depths[5] = float("nan")
    return replace(splats, depths=depths)


@pytest.mark.parametrize("spare", (0, 1, 1000))
@pytest.mark.parametrize("seed", range(3))
def test_same_lists_as_bin_splats(device: str, seed: int, spare: int):
    splats = some_splats(seed, device)
    expected = bin_splats(splats)
    pairs = len(expected.splats)
    got, total = bin_within(splats, pairs + spare)
    assert total.tolist() == [pairs] and pairs > 500
    assert torch.equal(got.ranges, expected.ranges) and torch.equal(got.offsets, expected.offsets)
    assert torch.equal(got.splats[:pairs], expected.splats) and torch.equal(got.slots[:pairs], expected.slots)
    assert len(got.splats) == pairs + spare and sorted(got.slots.tolist()) == list(range(pairs + spare))
    bare, total = bin_within(splats, pairs + spare, slots=False)
    assert torch.equal(bare.splats[:pairs], expected.splats) and torch.equal(bare.ranges, expected.ranges)
    assert total.tolist() == [pairs] and len(bare.slots) == 0
    colors = torch.ones(300, 3, device=device, requires_grad=True)
    with pytest.raises(ValueError, match="slots"):
        composite(splats, colors, bare)


@pytest.mark.parametrize("slots", (False, True))
@pytest.mark.parametrize("capacity", (1, 17, 400))
def test_too_little_room_is_reported_and_stays_in_bounds(device: str, capacity: int, slots: bool):
    splats = some_splats(1, device)
    pairs = len(bin_splats(splats).splats)
    tiles, total = bin_within(splats, capacity, slots=slots)
    assert total.tolist() == [pairs] and pairs > capacity
    assert len(tiles.splats) == capacity
    assert 0 <= int(tiles.splats.min()) and int(tiles.splats.max()) < 300
    assert 0 <= int(tiles.ranges.min()) and int(tiles.ranges.max()) <= capacity
    if slots:
        assert 0 <= int(tiles.slots.min()) and int(tiles.slots.max()) < capacity
        assert int(tiles.offsets.max()) == capacity
    image, alpha = composite(splats, torch.ones(300, 3, device=device), tiles, form="plain")
    assert torch.isfinite(image).all() and torch.isfinite(alpha).all()


@pytest.mark.parametrize("slots", (False, True))
def test_no_splats(device: str, slots: bool):
    tiles, total = bin_within(random_splats(0, 0, 40, 40, device), 8, slots=slots)
    assert total.tolist() == [0] and not tiles.ranges.any() and len(tiles.splats) == 8


@pytest.mark.parametrize("capacity", (0, -1, 2**30))
def test_impossible_room_is_refused(capacity: int):
    with pytest.raises(ValueError, match="capacity"):
        bin_within(random_splats(0, 3, 40, 40, "cpu"), capacity)
