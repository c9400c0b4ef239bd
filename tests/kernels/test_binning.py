"""Tiles: every pair that matters is there, sorted, counted, and nothing poisonous."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.splats import random_splats
from reference.binning import needed_pairs, usable
from scgs_warp.ops import binning
from scgs_warp.ops.binning import BandBinning, bin_splats
from scgs_warp.ops.binning_cuda import RadixBinning
from scgs_warp.ops.compositing import composite
from scgs_warp.runtime import debug, environment
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
        sharpness=splats.sharpness,
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


@pytest.mark.parametrize("sharpness", [0.1, 0.5, 4.0])
def test_sharp_splats_reach_less_far(device: str, sharpness: float):
    splats = random_splats(4, 150, 64, 48, device, log_scale=2.0)
    sharp, plain = check(replace(splats, sharpness=sharpness)), check(splats)
    assert len(sharp.splats) < len(plain.splats)


@pytest.mark.parametrize("tile_size", [4, 8, 32])
def test_other_sizes_of_tiles_agree_with_the_definition(device: str, tile_size: int):
    check(random_splats(5, 60, 50, 37, device), tile_size)


@pytest.mark.parametrize("count", [0, 1])
def test_none_and_one_are_listed(device: str, count: int):
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
def test_random_shapes_are_listed_in_all_their_tiles(seed: int, width: int, height: int, log_scale: int, aspect: int):
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


FIELDS = ("means2d", "conics", "opacities", "depths", "radii")
LISTS = ("ranges", "splats", "slots", "offsets")


def assert_both_sorts_agree(splats: Splats, device: str = "cpu", tile_size: int = 16) -> int:
    """By bands on a CPU, by radix sorts as on a GPU: the same lists, bit for bit. How many pairs there are."""
    geometry = [getattr(splats, name) for name in FIELDS]
    columns, rows = -(-splats.width // tile_size), -(-splats.height // tile_size)
    size = (splats.width, splats.height, columns, rows, tile_size)
    whole = (0, columns * rows)
    by_radix = RadixBinning([t.to(device) for t in geometry], size, whole).lists()
    for name, got, expected in zip(LISTS, BandBinning(geometry, size, whole).lists(), by_radix, strict=True):
        assert torch.equal(got, expected.cpu()), name
    return len(by_radix[1])


def test_lists_for_an_image_alone_have_no_slots(device: str):
    splats = random_splats(4, 300, 90, 70, device)
    whole, plain = bin_splats(splats), bin_splats(splats, slots=False)
    assert torch.equal(plain.ranges, whole.ranges) and torch.equal(plain.splats, whole.splats)
    assert len(whole.slots) == len(whole.splats) > 500
    if debug.enabled():
        return  # the lists are made whole, to be checked
    assert len(plain.slots) == 0
    channels = torch.rand(300, 3, device=device, requires_grad=True)
    with pytest.raises(ValueError, match="made for an image without gradients"):
        composite(splats, channels, plain)
    assert torch.equal(composite(splats, channels.detach(), plain)[0], composite(splats, channels, whole)[0].detach())


@pytest.mark.parametrize("seed", range(3))
def test_both_sorts_agree(device: str, seed: int):
    """Equal and negative depths, and both zeros."""
    splats = random_splats(seed, 300, 90, 70)
    depths = torch.round(4 * splats.depths) / 4 - 2.0
    splats = replace(splats, depths=torch.where(depths == 0, -depths, depths))
    assert assert_both_sorts_agree(splats, device) > 500


@pytest.mark.parametrize(("log_scale", "aspect"), [(-1.0, 0.5), (2.0, 2.0), (4.5, 1.5), (3.0, 4.0)])
@pytest.mark.parametrize("tile_size", [3, 16])
def test_both_sorts_agree_on_any_size_of_splat(device: str, log_scale: float, aspect: float, tile_size: int):
    """Within a window of 8 x 8 tiles, beyond it, needles, and slabs that end between two pixel centres."""
    splats = random_splats(11, 2000, 333, 250, log_scale=log_scale, aspect=aspect)
    assert assert_both_sorts_agree(splats, device, tile_size) > 1000


def test_both_sorts_agree_on_many_splats(device: str):
    """More than 16 bits count, in chunks of different lengths; a third of them culled."""
    splats = random_splats(12, 70_001, 640, 300, log_scale=0.0)
    radii = splats.radii * (torch.arange(70_001) % 3 != 0)[:, None].int()
    assert assert_both_sorts_agree(replace(splats, radii=radii), device) > 2**16


def test_many_splats_in_one_tile(device: str):
    """One band has it all, and few depths: sorted by depth, then by index."""
    splats = random_splats(13, 30_000, 8, 8, log_scale=-1.0, opacity=(0.5, 1.0))
    depths = torch.round(20.0 * splats.depths) / 20.0
    splats = replace(splats, means2d=splats.means2d + 36.0, depths=depths, width=800, height=800)
    assert assert_both_sorts_agree(splats, device) > 30_000
    tiles = bin_splats(splats)
    begin, end = tiles.ranges[2 * 50 + 2].tolist()
    inside = tiles.splats[begin:end].long()
    assert len(inside) > 20_000
    order = torch.argsort(depths[inside.sort().values], stable=True)
    assert torch.equal(inside, inside.sort().values[order])


@pytest.mark.parametrize("seed", range(4))
def test_both_sorts_agree_on_extreme_values(device: str, seed: int):
    """Values that overflow, underflow or are none, anywhere: two forms of the same arithmetic find the same tiles."""
    extremes = torch.tensor([0.0, -0.0, 1e-45, -1e-38, 1e-20, 1e20, -1e30, 3e38, torch.inf, -torch.inf, torch.nan])
    g = torch.Generator().manual_seed(seed)
    splats = random_splats(seed, 4000, 200, 120, log_scale=2.0)
    poisoned = {}
    for name in FIELDS[:4]:
        tensor = getattr(splats, name).clone()
        hit = torch.rand(tensor.shape, generator=g) < 0.15
        tensor[hit] = extremes[torch.randint(len(extremes), (int(hit.sum()),), generator=g)]
        poisoned[name] = tensor
    radii = torch.where(torch.rand(4000, 2, generator=g) < 0.05, -splats.radii, splats.radii)
    assert assert_both_sorts_agree(replace(splats, **poisoned, radii=radii), device) > 1000


def test_splats_that_leave_out_a_row_of_tiles_between_others(monkeypatch: pytest.MonkeyPatch):
    """Faint needles, nearly upright: between two tiles' pixel centres they touch no tile of a row. Nothing is written
    beyond a row's own counters."""
    g = torch.Generator().manual_seed(5)
    n, size = 4000, 48
    slope, along, across = (0.08 * torch.rand(n, generator=g), 900.0 + 1200.0 * torch.rand(n, generator=g), 0.3)
    xx, xy, yy = across + along * slope**2, along * slope, along
    determinant = xx * yy - xy * xy
    splats = random_splats(5, n, size, size)
    means = torch.stack([16.0 + 0.3 * torch.randn(n, generator=g), 24.0 + 4.0 * torch.randn(n, generator=g)], 1)
    opacities = 0.0041 + 0.002 * torch.rand(n, generator=g)
    conics = torch.stack([yy, -xy, xx], 1) / determinant[:, None]
    radii = torch.full((n, 2), 200, dtype=torch.int32)
    splats = replace(splats, means2d=means, conics=conics, opacities=opacities, radii=radii)
    beyond = []
    original = binning.launch

    def guarded(kernel, count, *args, **options):
        if kernel is not binning.kernels.sort_bands:
            return original(kernel, count, *args, **options)
        shape = args[5].shape
        counters = torch.full((shape[0] + 1, shape[1]), 7, dtype=torch.int32)
        original(kernel, count, *args[:5], counters[:-1], *args[6:], **options)
        beyond.append(counters[-1].tolist())

    monkeypatch.setattr(binning, "launch", guarded)
    tiles = bin_splats(splats)
    columns = torch.zeros(n, 3, dtype=torch.bool)
    for tile, splat in pairs_of(tiles):
        columns[splat, tile // 3] = True
    assert int((columns[:, 0] & ~columns[:, 1] & columns[:, 2]).sum()) > 5
    assert beyond == [[7, 7, 7]]
    assert assert_both_sorts_agree(splats) > n


def test_lists_are_empty_if_all_splats_are_culled(device: str):
    splats = random_splats(14, 500, 100, 60, device)
    tiles = bin_splats(replace(splats, radii=torch.zeros_like(splats.radii)))
    assert len(tiles.splats) == len(tiles.slots) == 0
    assert not tiles.ranges.any() and not tiles.offsets.any()
    assert tiles.ranges.shape == (7 * 4, 2) and tiles.offsets.shape == (501,)


def test_neither_threads_nor_chunks_change_anything(all_threads: None, monkeypatch: pytest.MonkeyPatch):
    splats = random_splats(7, 5000, 300, 200)
    splats = replace(splats, depths=torch.round(10.0 * splats.depths))
    results = []
    for threads, chunk in ((1, 1024), (2, 1024), (3, 1024), (1, 16), (3, 48), (2, 8192)):
        environment.configure(threads=threads)
        monkeypatch.setattr(binning, "CHUNK_SIZE", chunk)
        monkeypatch.setattr(binning, "MAX_CHUNKS", 1000)
        results.append(bin_splats(splats))
    for result in results[1:]:
        for name in LISTS:
            assert torch.equal(getattr(results[0], name), getattr(result, name)), name


def test_wrong_arguments_are_refused():
    splats = random_splats(0, 3, 20, 20)
    with pytest.raises(ValueError, match="conics must be"):
        bin_splats(replace(splats, conics=splats.conics[:2]))
    with pytest.raises(ValueError, match="positive"):
        bin_splats(replace(splats, width=0))


def test_too_many_pairs_are_refused_before_they_are_allocated():
    """Counted in 64 bits and refused, before anything of that size is allocated."""
    splats = random_splats(0, 3000, 16, 16, log_scale=0.0)
    conics = torch.tensor([1e-9, 0.0, 1e-9]).expand(3000, 3)
    huge = replace(splats, conics=conics, opacities=torch.ones(3000), width=16 * 1000, height=16 * 1000)
    with pytest.raises(ValueError, match=r"3000000000 pairs"):
        bin_splats(huge)
