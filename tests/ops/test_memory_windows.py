"""Images in windows of tiles: the bits of the whole image, forward and backward, however little memory there is."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from helpers.cuda_emulation import COMPILER, build, launcher
from helpers.splats import random_splats
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.errors import UserError
from scgs_warp.ops import binning_cuda, cuda_blocks, memory_windows
from scgs_warp.ops.binning import BandBinning, bin_splats, bin_window
from scgs_warp.ops.compositing import composite, demand
from scgs_warp.ops.memory_windows import Demand
from scgs_warp.rendering.rasterize import rasterization
from scgs_warp.rendering.render import render
from scgs_warp.runtime import debug, memory
from scgs_warp.training.loop import fit
from scgs_warp.training.visibility import view_contributions
from scgs_warp.types import Camera, Gaussians, Splats, Stats

LISTS = ("splats", "slots")
SIZE = (150, 85)  # 10 x 6 tiles, the last of each row and column cut


def some_splats(seed: int, device: str = "cpu", count: int = 400) -> Splats:
    return random_splats(seed, count, *SIZE, device, log_scale=1.8, opacity=(0.0, 0.6))


@pytest.mark.parametrize("window", [(0, 10), (10, 40), (20, 60), (23, 24), (50, 57), (35, 40), (0, 60)])
@pytest.mark.parametrize("radix", (False, True))
def test_a_window_lists_what_the_whole_image_does(window: tuple[int, int], radix: bool):
    splats = some_splats(1)
    whole = bin_splats(splats)
    if radix:
        geometry, size = binning_cuda.geometry_of(splats), (*SIZE, 10, 6, 16)
        ranges, listed, slots, offsets = binning_cuda.RadixBinning(geometry, size, window).lists()
        part = replace(whole, ranges=ranges, splats=listed, slots=slots, offsets=offsets)
    else:
        part = bin_window(splats, whole, window)
    begin, end = whole.ranges[window[0], 0], whole.ranges[window[1] - 1, 1]
    assert torch.equal(part.splats, whole.splats[begin:end]) and len(part.splats) > 20
    assert torch.equal(part.ranges[slice(*window)], whole.ranges[slice(*window)] - begin)
    lengths = part.ranges.diff(dim=1)[:, 0]
    assert not lengths[: window[0]].any() and not lengths[window[1] :].any()
    # A splat's slots are in the order that those of its tiles have in the whole image.
    assert torch.equal(part.slots.argsort(), whole.slots[begin:end].argsort())
    assert torch.equal(part.offsets.diff(), torch.bincount(part.splats, minlength=400))


def test_lists_longer_than_can_be_indexed_do_not_fit(monkeypatch):
    monkeypatch.setattr(memory, "fits", lambda need, device: need <= 1000)

    class Counted:
        max_entries, list_bytes, scratch_bytes, pairs = 100, 400, 0, 0

        def __init__(self, entries: int) -> None:
            self.entries = entries

    def fits(entries: int, fixed: int) -> bool:
        return memory_windows.fits(Counted(entries), Demand(fixed), torch.device("cpu"))

    assert fits(100, 600) and not fits(101, 600) and not fits(100, 601)


def test_windows_follow_each_other_and_are_rows_or_in_one():
    class Counted:
        max_entries, list_bytes, entries = 10**9, 0, 1

        def __init__(self, window: tuple[int, int]) -> None:
            self.pairs = self.scratch_bytes = 100 * (window[1] - window[0])

    for allowed in (401, 799, 2001, 11_000, 10**6):
        memory_room = allowed + 50
        found = cut_with(Counted, memory_room, columns=7, rows=5, fixed=50)
        assert [begin for begin, _ in found] == [0, *(end for _, end in found[:-1])] and found[-1][1] == 35
        for begin, end in found:
            assert (begin % 7 == 0 and end % 7 == 0) or begin // 7 == (end - 1) // 7
            assert 100 * (end - begin) <= allowed / 2
    assert len(found) == 1
    assert len(cut_with(Counted, 150, columns=7, rows=5, fixed=50)) == 35  # a tile may take all there is
    with pytest.raises(memory.NotEnoughMemory, match="one tile of it, with 100 splats"):
        cut_with(Counted, 149, columns=7, rows=5, fixed=50)
    with pytest.raises(memory.NotEnoughMemory, match="150 x 85"):
        cut_with(Counted, 49, columns=7, rows=5, fixed=50)


def cut_with(counted, room: int, columns: int, rows: int, fixed: int) -> list[tuple[int, int]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(memory, "room", lambda device: room)
        return memory_windows.cut(counted, columns, rows, Demand(fixed), some_splats(0))


def squeeze(monkeypatch: pytest.MonkeyPatch, spare: int) -> list[int]:
    """As if there were ``spare`` bytes beside what the image itself takes; how many windows each image was cut into."""
    cuts: list[int] = []
    original = memory_windows.cut

    def cut(count, columns, rows, needed: Demand, splats):
        monkeypatch.setattr(memory, "room", lambda device: needed.fixed + spare)
        cuts.append(len(found := original(count, columns, rows, needed, splats)))
        return found

    monkeypatch.setattr(memory_windows, "cut", cut)
    monkeypatch.setattr(memory_windows, "fits", lambda count, needed, device: False)
    return cuts


def draw(splats: Splats, form: str, channels: int = 3, gradients: bool = True) -> list[torch.Tensor]:
    """Image, alpha, and all gradients, absolute ones and statistics."""
    g = torch.Generator().manual_seed(3)
    count, device = len(splats.means2d), splats.means2d.device
    colors = torch.rand(count, channels, generator=g).to(device)
    background = torch.linspace(0.1, 0.9, channels, device=device)
    names = ("means2d", "conics", "opacities")
    leaves = [getattr(splats, name).clone().requires_grad_(gradients) for name in names]
    leaves += [colors.requires_grad_(gradients), background.requires_grad_(gradients)]
    splats = replace(splats, **dict(zip(names, leaves)))
    absgrad, stats = torch.empty(count, 2, device=device), Stats.zeros(count, device, absolute=True)
    tiles = bin_splats(splats, demand=demand(splats, colors, background))
    image, alpha = composite(splats, colors, tiles, background, stats=stats, absgrad=absgrad, form=form)  # type: ignore[arg-type]
    if not gradients:
        return [image, alpha]
    v_image, v_alpha = (torch.randn(x.shape, generator=g).to(device) for x in (image, alpha))
    found = torch.autograd.grad((image, alpha), leaves, (v_image, v_alpha))
    return [image.detach(), alpha.detach(), *found, absgrad, stats.grad_norm, stats.count, stats.max_radii]


@pytest.mark.parametrize("channels", (3, 4, 11))
@pytest.mark.parametrize("form", ("auto", "plain"))
def test_same_bits_in_windows_of_any_size(device: str, form: str, channels: int, monkeypatch: pytest.MonkeyPatch):
    splats = some_splats(2, device)
    whole = draw(splats, form, channels)
    assert whole[2].abs().max() > 0 and whole[0].std() > 0.05
    numbers = []
    for spare in (300_000, 100_000, 30_000, 15_000):
        with monkeypatch.context() as patch:
            cuts = squeeze(patch, spare)
            for got, expected in zip(draw(splats, form, channels), whole, strict=True):
                assert torch.equal(got, expected)
            numbers += cuts
    assert numbers == sorted(numbers) and numbers[0] > 1 and numbers[-1] > 40, numbers


@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler, or not Linux, whose fibres the shim uses")
def test_same_bits_in_windows_by_the_native_form(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cuda_blocks, "launch_native", launcher(build(tmp_path)))
    splats = some_splats(2)
    whole = draw(splats, "cuda")
    cuts = squeeze(monkeypatch, 22_000)
    assert all(torch.equal(got, expected) for got, expected in zip(draw(splats, "cuda"), whole, strict=True))
    assert cuts[0] > 10


def test_rasterization_and_render_go_through_windows(device: str, monkeypatch: pytest.MonkeyPatch):
    g = torch.Generator().manual_seed(9)
    means = (torch.randn(200, 3, generator=g) + torch.tensor([0.0, 0.0, 4.0])).to(device)
    quats, scales = torch.randn(200, 4, generator=g).to(device), torch.full((200, 3), 0.2, device=device)
    opacities, colors = torch.full((200,), 0.5, device=device), torch.rand(200, 3, generator=g).to(device)
    K = torch.tensor([[90.0, 0.0, 50.0], [0.0, 90.0, 40.0], [0.0, 0.0, 1.0]], device=device)
    viewmat = torch.eye(4, device=device)

    def results() -> list[torch.Tensor]:
        leaves = [x.clone().requires_grad_() for x in (means, quats, scales, opacities, colors)]
        renders, alphas, _ = rasterization(*leaves, viewmat[None], K[None], 100, 80, render_mode="RGB+ED")
        gradients = torch.autograd.grad(renders.square().sum(), leaves)
        gaussians = Gaussians(means, quats, scales, opacities, colors, torch.zeros(200, 0, 3, device=device))
        camera = Camera(viewmat, K, 100, 80)
        image = render(gaussians, camera)
        return [
            renders,
            alphas,
            *gradients,
            image.rgb,
            image.alpha,
            image.depth,
            view_contributions(gaussians, camera)[0],
        ]

    whole = results()
    cuts = squeeze(monkeypatch, 25_000)
    assert all(torch.equal(a, b) for a, b in zip(results(), whole, strict=True))
    assert len(cuts) == 3 and min(cuts) > 1


def test_training_in_windows_gives_the_same_checkpoint(tmp_path, monkeypatch: pytest.MonkeyPatch):
    config, data = tiny_config(24, motion={"model": "static"}), tiny_dataset(4, 32)
    fit(config, data, output=tmp_path / "whole")
    cuts = squeeze(monkeypatch, 80_000)
    fit(config, data, output=tmp_path / "bands")
    assert len(cuts) >= 24 and max(cuts) > 1
    files = [(tmp_path / name / "checkpoint.safetensors").read_bytes() for name in ("whole", "bands")]
    assert files[0] == files[1]


def test_without_gradients_fewer_windows_do(monkeypatch: pytest.MonkeyPatch):
    splats = some_splats(4)
    whole = draw(splats, "auto", gradients=False)
    cuts = squeeze(monkeypatch, 100_000)
    assert all(torch.equal(a, b) for a, b in zip(draw(splats, "auto", gradients=False), whole))
    draw(splats, "auto")
    assert 1 < cuts[0] < cuts[1]


def test_a_tile_that_does_not_fit_is_refused_with_the_figures(monkeypatch: pytest.MonkeyPatch):
    squeeze(monkeypatch, 4000)
    with pytest.raises(memory.NotEnoughMemory) as caught:
        draw(some_splats(5), "auto")
    text = str(caught.value)
    assert "an image of 150 x 85 with 400 Gaussians: one tile of it, with" in text and "MiB of memory" in text
    assert "make the image smaller or use fewer Gaussians" in text and "\n" not in text
    assert isinstance(caught.value, UserError) and isinstance(caught.value, MemoryError)


def test_an_image_that_does_not_fit_is_refused_before_it_is_made():
    few = replace(some_splats(6, count=3), width=1_000_000, height=1_000_000)
    with pytest.raises(memory.NotEnoughMemory, match="an image of 1000000 x 1000000 with 3 Gaussians needs") as caught:
        bin_splats(few, demand=demand(few, torch.zeros(3, 3)))
    assert "22,352 GiB" in str(caught.value)  # 6 planes of floats
    with pytest.raises(ValueError, match="3906250000 tiles"):
        bin_splats(few)


def test_more_pairs_than_a_list_can_index_are_cut():
    """As ``test_too_many_pairs`` in ``test_binning``, but with somebody who draws in windows."""
    splats = random_splats(0, 3000, 16, 16, log_scale=0.0)
    conics = torch.tensor([1e-9, 0.0, 1e-9]).expand(3000, 3).contiguous()
    huge = replace(splats, conics=conics, opacities=torch.ones(3000), width=16 * 1000, height=16 * 1000)
    tiles = bin_splats(huge, demand=Demand(0))
    assert len(tiles.windows) > 1 and tiles.windows[-1][1] == 10**6
    last = tiles.windows[-1]
    assert BandBinning(binning_cuda.geometry_of(huge), (16000, 16000, 1000, 1000, 16), last).pairs == 3000 * (
        last[1] - last[0]
    )


def test_lists_alone_must_fit(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(memory, "fits", lambda need, device: False)
    with pytest.raises(memory.NotEnoughMemory, match="pairs of splat and tile needs"):
        bin_splats(some_splats(7))


def test_debug_mode_follows_the_windows(monkeypatch: pytest.MonkeyPatch):
    whole = draw(some_splats(8), "auto")
    squeeze(monkeypatch, 22_000)
    debug.enable()
    try:
        assert all(torch.equal(a, b) for a, b in zip(draw(some_splats(8), "auto"), whole))
    finally:
        debug.enable(False)
