"""Tiles: every pair that matters is there, sorted, counted, and nothing poisonous."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from splats import random_splats

from reference.binning import needed_pairs, usable
from scgs_warp import environment
from scgs_warp.ops.binning import _bin_by_bands, bin_splats
from scgs_warp.ops.binning_cuda import bin_by_radix
from scgs_warp.types import Splats, Tiles


def pairs_of(tiles: Tiles) -> list[tuple[int, int]]:
    ranges, splats = tiles.ranges.cpu(), tiles.splats.cpu()
    return [(t, int(i)) for t, (b, e) in enumerate(ranges.tolist()) for i in splats[b:e]]


def check(splats: Splats, tile_size: int = 16) -> Tiles:
    tiles = bin_splats(splats, tile_size)
    splats = Splats(
        *(getattr(splats, n).cpu() for n in ("means2d", "conics", "depths", "opacities", "radii")),
        width=splats.width,
        height=splats.height,
    )
    found = pairs_of(tiles)
    assert len(set(found)) == len(found) == len(tiles.splats) == len(tiles.slots)
    missing = needed_pairs(splats, tile_size) - set(found)
    assert not missing, f"pairs left out: {sorted(missing)[:5]}"
    needless = set(found) - needed_pairs(splats, tile_size)
    # The rectangle of pixel centres may meet the ellipse between two centres: a few pairs, never many.
    assert len(needless) <= 0.35 * len(found) + 2 * len(splats.means2d)
    for begin, end in tiles.ranges.cpu().tolist():
        keys = [(float(splats.depths[i]), int(i)) for i in tiles.splats[begin:end].cpu()]
        assert keys == sorted(keys)
    counts = torch.bincount(tiles.splats.cpu().long(), minlength=len(splats.means2d))
    offsets = tiles.offsets.cpu()
    assert torch.equal(offsets.diff(), counts) and offsets[0] == 0
    assert sorted(tiles.slots.tolist()) == list(range(len(found)))
    owners = torch.repeat_interleave(torch.arange(len(counts)), counts)
    assert torch.equal(owners[tiles.slots.cpu().long()], tiles.splats.cpu().long())
    assert counts[~usable(splats)].sum() == 0
    return tiles


@pytest.mark.parametrize("size", [(1, 1), (17, 33), (64, 48), (100, 15)])
@pytest.mark.parametrize("seed", range(3))
def test_every_pair_that_matters(device: str, seed: int, size: tuple[int, int]):
    check(random_splats(seed, 150, *size, device))


@pytest.mark.parametrize("tile_size", [4, 8, 32])
def test_other_tile_sizes(device: str, tile_size: int):
    check(random_splats(5, 60, 50, 37, device), tile_size)


@pytest.mark.parametrize("count", [0, 1])
def test_few(device: str, count: int):
    tiles = check(random_splats(1, count, 40, 40, device))
    assert tiles.ranges.shape == (9, 2)


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 10**6),
    width=st.integers(1, 70),
    height=st.integers(1, 70),
    log_scale=st.integers(-3, 6),
    aspect=st.integers(0, 4),
)
def test_any_shape(seed: int, width: int, height: int, log_scale: int, aspect: int):
    check(random_splats(seed, 12, width, height, log_scale=log_scale, aspect=aspect))


def test_needless_pairs_are_only_those_between_pixel_centres(device: str):
    """Large round splats: the exact ellipse test keeps far fewer tiles than the bounding box would."""
    splats = random_splats(3, 40, 256, 256, device, log_scale=3.5, aspect=1.5)
    found = set(pairs_of(bin_splats(splats)))
    cpu = Splats(
        *(getattr(splats, n).cpu() for n in ("means2d", "conics", "depths", "opacities", "radii")),
        width=256,
        height=256,
    )
    assert found <= needed_pairs(cpu, margin=0.1)


@pytest.mark.parametrize("field", ["means2d", "conics", "opacities", "depths"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_poison_is_culled(device: str, field: str, value: float):
    splats = random_splats(2, 30, 40, 40, device)
    clean = bin_splats(replace(splats, radii=splats.radii * (torch.arange(30, device=device) != 7)[:, None].int()))
    tensor = getattr(splats, field).clone()
    tensor.view(30, -1)[7, 0] = value
    poisoned = check(replace(splats, **{field: tensor}))
    for name in ("ranges", "splats", "slots", "offsets"):
        assert torch.equal(getattr(clean, name), getattr(poisoned, name)), name


def test_culled_are_left_out(device: str):
    splats = random_splats(4, 5, 32, 32, device)
    conics = splats.conics.clone()
    conics[0] = torch.tensor([1.0, 2.0, 1.0])  # indefinite
    conics[1] = torch.tensor([-1.0, 0.0, -1.0])
    opacities = splats.opacities.clone()
    opacities[2] = 0.0
    opacities[3] = 0.0039
    assert set(check(replace(splats, conics=conics, opacities=opacities)).splats.tolist()) <= {4}


def test_equal_depths_keep_index_order(device: str):
    splats = random_splats(6, 80, 48, 48, device)
    tiles = check(replace(splats, depths=torch.ones_like(splats.depths)))
    for begin, end in tiles.ranges.tolist():
        assert tiles.splats[begin:end].tolist() == sorted(tiles.splats[begin:end].tolist())


@pytest.mark.parametrize("seed", range(3))
def test_both_sorts_agree(device: str, seed: int):
    """Counting on a CPU, radix sort on a GPU: the same lists, with equal and negative depths too."""
    splats = random_splats(seed, 300, 90, 70)
    depths = torch.round(4 * splats.depths) / 4 - 2.0
    splats = replace(splats, depths=torch.where(depths == 0, -depths, depths))  # 0 and -0
    geometry = [splats.means2d, splats.conics, splats.opacities, splats.depths, splats.radii]
    size = (90, 70, 6, 5, 16)
    by_radix = bin_by_radix([t.to(device) for t in geometry], size)
    for got, expected in zip(by_radix, _bin_by_bands(geometry, size)):
        assert torch.equal(got.cpu(), expected)


def test_threads_change_nothing(all_threads: None):
    splats = random_splats(7, 5000, 300, 200)
    results = []
    for threads in (1, 2):
        environment.configure(threads=threads)
        results.append(bin_splats(splats))
    for name in ("ranges", "splats", "slots", "offsets"):
        assert torch.equal(getattr(results[0], name), getattr(results[1], name)), name


def test_wrong_arguments():
    splats = random_splats(0, 3, 20, 20)
    with pytest.raises(ValueError, match="conics must be"):
        bin_splats(replace(splats, conics=splats.conics[:2]))
    with pytest.raises(ValueError, match="positive"):
        bin_splats(replace(splats, width=0))


def test_too_many_pairs():
    """Counted in 64 bits and refused, before anything of that size is allocated."""
    splats = random_splats(0, 3000, 16, 16, log_scale=0.0)
    conics = torch.tensor([1e-9, 0.0, 1e-9]).expand(3000, 3)
    huge = replace(splats, conics=conics, opacities=torch.ones(3000), width=16 * 1000, height=16 * 1000)
    with pytest.raises(ValueError, match=r"3000000000 pairs"):
        bin_splats(huge)
