"""Laws that hold for any input; a broken law raises with its subject."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from scgs_warp.types import Tiles


def finite(name: str, *tensors: Tensor | None) -> None:
    for place, tensor in enumerate(tensors):
        if tensor is not None and not bool(tensor.isfinite().all()):
            where = torch.where(~tensor.reshape(-1).isfinite())[0]
            raise AssertionError(f"{name}[{place}] is not finite at {where[:5].tolist()} of {tuple(tensor.shape)}")


def equal(name: str, ours: Tensor, other: Tensor) -> None:
    """Require equal bits, the sign of zero apart; NaN equals NaN."""
    assert ours.shape == other.shape, f"{name}: {tuple(ours.shape)} and {tuple(other.shape)}"
    differs = (ours != other) & ~(ours.isnan() & other.isnan())
    if bool(differs.any()):
        where = torch.where(differs.reshape(-1))[0][:3]
        a, b = ours.reshape(-1)[where].tolist(), other.reshape(-1)[where].tolist()
        raise AssertionError(f"{name} differs in {int(differs.sum())} of {differs.numel()} places: {a} and {b}")


def zero(name: str, *tensors: Tensor) -> None:
    for place, tensor in enumerate(tensors):
        assert not bool(tensor.any()), f"{name}[{place}] must be zero"


def all_zero_where(name: str, rows: Tensor, tensors: Sequence[Tensor]) -> None:
    zero(name, *(tensor[rows] for tensor in tensors))


def counted_as_emitted(tiles: Tiles, count: int) -> None:
    """Require lists as counted: nothing missing, doubled or out of range."""
    pairs = len(tiles.splats)
    offsets, ranges = tiles.offsets.cpu(), tiles.ranges.cpu().long()
    assert len(offsets) == count + 1 and int(offsets[0]) == 0 and int(offsets[-1]) == pairs
    assert bool((offsets.diff() >= 0).all())
    assert int((ranges[:, 1] - ranges[:, 0]).sum()) == pairs and bool((ranges[:, 1] >= ranges[:, 0]).all())
    splats, slots = tiles.splats.cpu().long(), tiles.slots.cpu().long()
    assert torch.equal(torch.bincount(splats, minlength=count), offsets.diff()), "counted is not emitted"
    assert torch.equal(slots.sort().values, torch.arange(pairs)), "slots are no permutation"
    owners = torch.repeat_interleave(torch.arange(count), offsets.diff())
    assert torch.equal(owners[slots], splats), "a slot belongs to another splat"
