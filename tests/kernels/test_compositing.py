"""Compositing: every form against float64 and against each other."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from helpers.compositing_checks import (
    assert_images_agree,
    assert_rows_agree,
    check,
    forms,
    leaves,
    random_channels,
    weights_of,
)
from helpers.splats import random_splats
from reference.compositing import composite as composite_reference
from scgs_warp.kernels import compositing as kernels
from scgs_warp.kernels.types import STEP_FINE, STEP_HALTED, STEP_LOSS, STEP_REGULARISER
from scgs_warp.ops import compositing_cuda
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.compositing import composite
from scgs_warp.rendering.render import expected_depth
from scgs_warp.runtime import environment
from scgs_warp.runtime.launch import launch
from scgs_warp.types import Splats, Stats, Tiles


@pytest.mark.parametrize("c", [1, 3, 4, 5, 8, 11])
def test_any_number_of_channels_agrees_with_float64(device: str, c: int):
    check(random_splats(c, 200, 50, 40, device), random_channels(c, 200, c, device), c, device)


@pytest.mark.parametrize("size", [(1, 1), (17, 33), (16, 16), (33, 15), (100, 3)])
@pytest.mark.parametrize("seed", range(2))
def test_any_size_agrees_with_float64(device: str, seed: int, size: tuple[int, int]):
    check(random_splats(seed, 120, *size, device), random_channels(seed, 120, 4, device), seed, device)


@pytest.mark.parametrize(
    "kind",
    [
        {"opacity": (1.0, 1.0)},  # clamped alpha, sticky end
        {"opacity": (0.0, 0.02)},  # near the threshold
        {"log_scale": 5.0},  # larger than the image
        {"log_scale": -4.0},  # all low-pass
        {"log_scale": 2.0, "aspect": 2.0},  # needles
    ],
    ids=["opaque", "faint", "huge", "tiny", "needles"],
)
def test_extreme_splats_agree_with_float64(device: str, kind: dict):
    check(random_splats(11, 250, 48, 40, device, **kind), random_channels(11, 250, 4, device), 11, device)


@pytest.mark.parametrize("sharpness", [0.1, 0.5, 4.0])
@pytest.mark.parametrize(
    "kind",
    [{}, {"opacity": (1.0, 1.0)}, {"opacity": (0.0, 0.02)}, {"log_scale": 4.0}, {"log_scale": 2.0, "aspect": 2.0}],
    ids=["mixed", "opaque", "faint", "huge", "needles"],
)
def test_sharp_splats_agree_with_float64_and_differ_from_gaussians(device: str, kind: dict, sharpness: float):
    splats = random_splats(12, 250, 48, 40, device, sharpness=sharpness, **kind)
    channels = random_channels(12, 250, 4, device)
    check(splats, channels, 12, device)
    image, _ = composite(splats, channels, bin_splats(splats))
    plain, _ = composite(replace(splats, sharpness=0.0), channels, bin_splats(splats))
    assert (image - plain).abs().max() > 5e-3


@pytest.mark.parametrize("n", [0, 1])
def test_none_and_one_agree_with_float64(device: str, n: int):
    splats = random_splats(3, n, 20, 20, device, opacity=(0.5, 0.9))
    splats = replace(splats, means2d=torch.full_like(splats.means2d, 9.0))
    check(splats, random_channels(3, n, 3, device), 3, device)


@settings(deadline=None, max_examples=15)
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 80),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    c=st.integers(1, 9),
    log_scale=st.integers(-1, 4),
    sharpness=st.sampled_from([0.0, 0.5, 2.0]),
)
def test_random_scenes_agree_with_float64(
    seed: int, n: int, width: int, height: int, c: int, log_scale: int, sharpness: float
):
    splats = random_splats(seed, n, width, height, log_scale=log_scale, sharpness=sharpness)
    channels, background = random_channels(seed, n, c), torch.rand(c)
    tiles = bin_splats(splats)
    expected, expected_alpha = composite_reference(splats, channels, tiles, background)
    for form in forms("cpu"):
        image, alpha = composite(splats, channels, tiles, background, form=form)  # type: ignore[arg-type]
        flips = (image.double() - expected).abs() > 1e-5
        assert flips.any(0).sum() <= 1 + 1e-3 * width * height  # small images: one pixel may lie at a threshold
        assert (image.double() - expected).abs().max() <= 8e-3
        assert (alpha.double() - expected_alpha).abs().max() <= 8e-3


@pytest.mark.parametrize("more", [False, True])
@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize("c", [1, 3, 4, 8])
@pytest.mark.parametrize("n", [1, 16, 37])
def test_sums_of_slots_have_the_same_bits(n: int, c: int, absolute: bool, more: bool):
    """Of the form for a CPU and the portable one, where some gradients overflow, too."""
    generator = torch.Generator().manual_seed(n + c)
    counts = torch.randint(0, 6, (n,), generator=generator)
    counts[0] = 3
    offsets = torch.cat([torch.zeros(1, dtype=torch.long), counts.cumsum(0)])
    slots = torch.randn(int(offsets[-1]), 16, generator=generator)
    slots[::7, :9] = torch.tensor([torch.inf, -torch.inf, torch.nan, 1e38, -1e38, 3e37, 1e30, 1e37, torch.nan])
    shapes = ((n, 2), (n, 3), (n,), (n, c), (n, 2))
    before = [torch.randn(shape, generator=generator) for shape in shapes]
    results = []
    for form in ("cpu", "plain"):
        outputs = [tensor.clone() for tensor in before]
        wanted = (*outputs[:4], outputs[4] if absolute else None)
        compositing_cuda.sum_slots(form, offsets, slots, wanted, more=more)
        results.append(outputs)
    for got, expected in zip(*results):
        assert torch.equal(got.isnan(), expected.isnan())
        assert torch.equal(got.nan_to_num(7.0).view(torch.int32), expected.nan_to_num(7.0).view(torch.int32))
    assert torch.equal(results[0][4], before[4]) != absolute
    assert all(tensor.isfinite().all() for tensor in results[0][:3])
    assert results[0][3].isnan().any()  # gradients of colours are not limited


def backward_buffers(splats: Splats, channels: Tensor, form: str, absolute: bool) -> tuple[list[Tensor], Stats, Tensor]:
    n, device = len(channels), channels.device
    own, found = leaves(splats, channels, torch.zeros(channels.shape[1], device=device), torch.float32)
    stats, absgrad = Stats.zeros(n, device, absolute), torch.full((n, 2), float("nan"), device=device)
    stats.grad_norm += 1.0
    stats.count += 2.0
    stats.max_radii += 0.05
    tiles = bin_splats(splats)
    image, _ = composite(own, found[3], tiles, found[4], stats=stats, absgrad=absgrad, form=form)  # type: ignore[arg-type]
    (image * weights_of(4, *image.shape).to(image)).sum().backward()
    return [t.grad for t in found if t.grad is not None], stats, absgrad


@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize("c", [3, 9])
def test_stats_and_absolute_gradients_agree_with_float64(device: str, absolute: bool, c: int):
    splats, channels = random_splats(9, 90, 40, 24, device), random_channels(9, 90, c, device)
    splats = replace(splats, radii=splats.radii * (torch.arange(90, device=device) % 7 != 0)[:, None].int())
    saved: dict = {}
    image, _ = composite_reference(splats, channels, bin_splats(splats), saved=saved)
    (image * weights_of(4, *image.shape).double()).sum().backward()
    expected = torch.zeros(90, 2, dtype=torch.float64)
    signed = torch.zeros(90, 2, dtype=torch.float64)
    for offsets, index in saved.values():
        if len(index):
            expected.index_add_(0, index, offsets.grad.abs().sum(1))
            signed.index_add_(0, index, offsets.grad.sum(1))
    for form in forms(device):
        _, stats, absgrad = backward_buffers(splats, channels, form, absolute)
        assert_rows_agree(form, absgrad, expected)
        radii = splats.radii.cpu().max(1).values
        pixel = expected if absolute else signed
        norm = (pixel * torch.tensor([20.0, 12.0])).norm(dim=1)
        assert torch.allclose(stats.grad_norm.cpu().double(), 1.0 + torch.where(radii > 0, norm, 0.0), rtol=2e-3)
        assert torch.equal(stats.count.cpu(), 2.0 + (radii > 0).float())
        assert torch.allclose(stats.max_radii.cpu(), torch.clamp(radii / 40.0, min=0.05))


@pytest.mark.parametrize("outcome", [STEP_FINE, STEP_HALTED, STEP_LOSS, STEP_REGULARISER])
def test_a_step_that_is_not_committed_adds_no_statistics(outcome: int, device: str):
    splats, channels = random_splats(9, 90, 40, 24, device), random_channels(9, 90, 3, device)
    always, gated = (Stats.zeros(90, device) for _ in range(2))
    gated.outcome = torch.tensor([outcome], dtype=torch.int32, device=device)
    for stats in (always, gated):
        own, found = leaves(splats, channels, torch.zeros(3, device=device), torch.float32)
        composite(own, found[3], bin_splats(splats), found[4], stats=stats)[0].sum().backward()
    for values, expected in zip(gated.sums, always.sums):
        assert torch.equal(values, expected if outcome == STEP_FINE else torch.zeros_like(expected))
        assert expected.any()


@pytest.mark.parametrize("unit", [1.0, 0.1])
def test_the_depth_of_a_pixel_is_a_mean_over_its_alpha(unit: float, device: str):
    """Of what was blended, in the caller's units; a pixel without alpha has depth 0."""
    alpha = torch.tensor([0.0, 1e-3, 0.25, 0.5, 0.999], device=device)
    true = torch.tensor([0.0, 4.0, 3.0, 0.7, 12.0], device=device)
    found = torch.full_like(alpha, float("nan"))
    launch(kernels.expected_depth, 5, true * alpha, alpha, unit, found)
    torch.testing.assert_close(found.double(), true.double() / unit, rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("pixels", [1, 5, 16, 1000])
@pytest.mark.parametrize("unit", [1.0, 0.1])
def test_depths_are_the_same_with_and_without_gradients(unit: float, pixels: int, device: str):
    random = torch.Generator().manual_seed(pixels)
    alpha = (torch.rand(pixels, generator=random) - 0.2).clamp_min(0.0).to(device)
    accumulated = (5.0 * torch.rand(pixels, generator=random)).to(device) * alpha
    expected = accumulated.double() / alpha.double().clamp_min(1e-10) / unit
    torch.testing.assert_close(expected_depth(accumulated, alpha, unit).double(), expected, rtol=1e-6, atol=0.0)
    with torch.no_grad():
        found = expected_depth(accumulated, alpha, unit)
    torch.testing.assert_close(found.double(), expected, rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("channels", [1, 4, 6, 11])
def test_depth_is_divided_where_it_is_drawn(channels: int, device: str):
    """The last channel is the expected depth, to the bit; the others and alpha stay as they are."""
    splats, values = random_splats(21, 12, 70, 45, device), random_channels(21, 12, channels, device)
    background = torch.cat([torch.rand(channels - 1), torch.zeros(1)]).to(device)
    tiles = bin_splats(splats)
    with torch.no_grad():
        for form in forms(device):
            image, alpha = composite(splats, values, tiles, background, form=form)  # type: ignore[arg-type]
            for unit in (1.0, 0.3):
                found, same = composite(splats, values, tiles, background, depth_unit=unit, form=form)  # type: ignore
                expected = image[-1].double() / alpha.double().clamp_min(1e-10) / unit
                torch.testing.assert_close(found[-1].double(), expected, rtol=1e-6, atol=0.0)
                assert torch.equal(found[:-1], image[:-1]) and torch.equal(same, alpha)
    assert float((alpha == 0).sum()) > 0 and float(found[-1][alpha == 0].abs().max()) == 0.0


@pytest.mark.parametrize("unit", [0.0, -2.0, float("nan"), float("inf")])
def test_a_unit_of_depth_is_positive(unit: float):
    splats, channels = random_splats(12, 100, 40, 40), random_channels(12, 100, 4)
    with pytest.raises(ValueError, match="depth_unit must be positive and finite"):
        composite(splats, channels, bin_splats(splats), depth_unit=unit)


def test_an_expected_depth_has_no_gradient():
    splats, channels = random_splats(12, 100, 40, 40), random_channels(12, 100, 4).requires_grad_()
    with pytest.raises(ValueError, match="depth_unit is for images without gradients"):
        composite(splats, channels, bin_splats(splats), depth_unit=1.0)


def test_threads_change_nothing(all_threads: None):
    splats, channels = random_splats(10, 3000, 200, 150), random_channels(10, 3000, 4)
    results = []
    for threads in (1, 2):
        environment.configure(threads=threads)
        found, stats, absgrad = backward_buffers(splats, channels, "cpu", True)
        results.append([*found, *composite(splats, channels, bin_splats(splats)), stats.grad_norm, absgrad])
    assert all(torch.equal(a, b) for a, b in zip(*results))


def test_same_without_gradients(device: str):
    splats, channels = random_splats(12, 100, 40, 40, device), random_channels(12, 100, 6, device)
    tiles = bin_splats(splats)
    for form in forms(device):
        plain = composite(splats, channels, tiles, form=form)  # type: ignore[arg-type]
        tracked = composite(splats, channels.clone().requires_grad_(), tiles, form=form)  # type: ignore[arg-type]
        assert tracked[0].requires_grad and not plain[0].requires_grad
        assert torch.equal(plain[0], tracked[0].detach()) and torch.equal(plain[1], tracked[1].detach())


def test_other_tile_sizes_take_the_pixel_form(device: str):
    splats, channels = random_splats(13, 60, 30, 30, device), random_channels(13, 60, 3, device)
    image, _ = composite(splats, channels, bin_splats(splats, 8))
    assert_images_agree(image, composite_reference(splats, channels, bin_splats(splats))[0])


def test_crop_of_the_twin():
    splats, channels = random_splats(14, 60, 50, 40), random_channels(14, 60, 3)
    tiles: Tiles = bin_splats(splats)
    whole, crop = (composite_reference(splats, channels, tiles, crop=c)[0] for c in (None, (5, 7, 37, 33)))
    assert torch.allclose(whole[:, 7:33, 5:37], crop, atol=1e-14)


def test_wrong_arguments_are_refused():
    splats, channels = random_splats(0, 5, 20, 20), random_channels(0, 5, 3)
    tiles = bin_splats(splats)
    with pytest.raises(ValueError, match="channels must be"):
        composite(splats, channels[:4], tiles)
    with pytest.raises(ValueError, match="background must be"):
        composite(splats, channels, tiles, torch.zeros(4))
    with pytest.raises(ValueError, match="form must be"):
        composite(splats, channels, tiles, form="fast")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="absgrad must be"):
        composite(splats, channels, tiles, absgrad=torch.zeros(5))
    with pytest.raises(ValueError, match="tiles are of"):
        composite(replace(splats, width=21), channels, tiles)
