"""Compositing of splats at the limits: opaque ones, needles, and values that are left out."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from helpers.compositing_checks import NAMES, assert_images_agree, forms, gradients, random_channels
from helpers.splats import random_splats
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.compositing import composite
from scgs_warp.types import Splats


def test_a_pixel_ends_for_good(device: str):
    """Splats of alpha 0.99, 0.98, 0.9, 0.5 in a row: the third would leave 2e-5, so the fourth is not added either."""
    one = random_splats(0, 1, 5, 5)
    conics = torch.tensor([[1e-6, 0.0, 1e-6]]).repeat(4, 1)
    splats = Splats(
        *(
            t.to(device)
            for t in (
                torch.full((4, 2), 2.5),
                conics,
                torch.arange(1.0, 5.0),
                torch.tensor([0.99, 0.98, 0.9, 0.5]),
                one.radii.repeat(4, 1).clamp(min=10),
            )
        ),
        width=5,
        height=5,
    )
    channels = torch.eye(4, device=device)
    for form in forms(device):
        image, alpha = composite(splats, channels, bin_splats(splats), form=form)  # type: ignore[arg-type]
        expected = torch.tensor([0.99, 0.0098, 0.0, 0.0])
        assert torch.allclose(image[:, 2, 2].cpu(), expected, atol=1e-5)
        assert abs(float(alpha[2, 2]) - 0.9998) < 1e-5


def test_clamped_alpha_passes_no_gradient(device: str):
    splats = random_splats(0, 1, 8, 8, device)
    splats = replace(
        splats,
        means2d=torch.full_like(splats.means2d, 4.0),
        conics=torch.tensor([[1e-9, 0.0, 1e-9]], device=device),
        opacities=torch.ones(1, device=device),
        radii=torch.full_like(splats.radii, 10),
    )
    for form in forms(device):
        found = gradients(splats, torch.ones(1, 3, device=device), torch.zeros(3, device=device), 0, form)
        assert all(not g.any() for g in found[:3]) and found[3].any()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("field", ["means2d", "conics", "opacities", "channels"])
def test_poison_is_left_out(device: str, field: str, value: float):
    splats, channels = random_splats(8, 60, 30, 30, device), random_channels(8, 60, 4, device)
    background = torch.rand(4, generator=torch.Generator().manual_seed(0)).to(device)
    without = replace(splats, radii=splats.radii * (torch.arange(60, device=device) != 9)[:, None].int())
    poisoned, poisoned_channels = splats, channels
    if field == "channels":
        poisoned_channels = channels.clone()
        poisoned_channels[9, 2] = value
    else:
        tensor = getattr(splats, field).clone()
        tensor.view(60, -1)[9, 0] = value
        poisoned = replace(splats, **{field: tensor})
    for form in forms(device):
        expected = composite(without, channels, bin_splats(without), background, form=form)  # type: ignore[arg-type]
        got = composite(poisoned, poisoned_channels, bin_splats(poisoned), background, form=form)  # type: ignore[arg-type]
        assert_images_agree(got[0], expected[0], 1e-6)
        assert torch.isfinite(got[1]).all()
        for name, gradient in zip(NAMES, gradients(poisoned, poisoned_channels, background, 8, form)):
            assert torch.isfinite(gradient).all(), f"{form}: {name}"


@pytest.mark.parametrize("sharpness", [0.0, 0.5])
@pytest.mark.parametrize("nudge", [0.0, 1e-4, 1e-3])
def test_a_splat_shows_at_the_pixel_of_its_mean(device: str, nudge: float, sharpness: float):
    """One splat at the centre of each pixel: rounding must not take its own pixel for one outside of it."""
    side, generator = 20, torch.Generator().manual_seed(3)
    index = torch.arange(side * side)
    means = torch.stack([index % side, index // side], 1) + 0.5
    means = means + nudge * torch.randn(means.shape, generator=generator)
    narrow, wide = 3.3 * torch.rand(2, side * side, generator=generator)
    lean = (2.0 * torch.rand(side * side, generator=generator) - 1.0) * (narrow * wide).sqrt()
    one = random_splats(0, 1, side, side, sharpness=sharpness)
    splats = replace(
        one,
        means2d=means,
        conics=torch.stack([narrow, 0.99 * lean, wide], 1),
        depths=index + 1.0,
        opacities=torch.full((side * side,), 0.02),
        radii=torch.full((side * side, 2), 10, dtype=one.radii.dtype),
    )
    names = ("means2d", "conics", "depths", "opacities", "radii")
    splats = replace(splats, **{name: getattr(splats, name).to(device) for name in names})
    channels = torch.eye(side * side)[:, ::7].contiguous().to(device)
    for form in forms(device):
        image, _ = composite(splats, channels, bin_splats(splats), form=form)  # type: ignore[arg-type]
        own = image.cpu().flatten(1)[torch.arange(image.shape[0]), index[::7]]
        assert own.min() > 0.01, form


def test_a_long_needle_with_a_broken_channel_is_left_out(device: str):
    """Its squared distance rounds to less than zero where its nearest point is sought."""
    one, c = random_splats(0, 1, 16, 16, device), 4
    needle = replace(
        one,
        means2d=torch.tensor([[-5864.413, -3607.5933]], device=device),
        conics=torch.tensor([[0.91625553, -1.4881736, 2.417078]], device=device),
        opacities=torch.full((1,), 0.99, device=device),
        radii=torch.full_like(one.radii, 10_000),
    )
    channels = torch.full((1, c), torch.nan, device=device)
    background = torch.full((c,), 0.5, device=device)
    tiles = bin_splats(needle)
    assert len(tiles.splats) == 1
    for form in forms(device):
        image, alpha = composite(needle, channels, tiles, background, form=form)  # type: ignore[arg-type]
        assert torch.equal(image, background[:, None, None].expand_as(image)), form
        assert not alpha.any(), form


def test_no_rounding_makes_a_needle_more_opaque(device: str):
    """The squared distance of a pixel from a needle thousands of pixels long often rounds to less than zero."""
    count, side, generator = 64, 16, torch.Generator().manual_seed(5)
    angles = torch.pi * torch.rand(count, generator=generator).double()
    along = torch.stack([angles.cos(), angles.sin()], 1)
    away = (
        5000.0
        * torch.rand(count, 1, generator=generator)
        * torch.where(torch.arange(count) % 2 == 0, 1.0, -1.0)[:, None]
    )
    across = torch.stack([-along[:, 1], along[:, 0]], 1)
    products = [
        along[:, i] * along[:, j] / 4000.0**2 + across[:, i] * across[:, j] for i, j in ((0, 0), (0, 1), (1, 1))
    ]
    one, drawn = random_splats(0, 1, side, side), 0
    for needle in range(count):
        splats = replace(
            one,
            means2d=(side / 2 + away * along)[needle : needle + 1].float().to(device),
            conics=torch.stack(products, 1)[needle : needle + 1].float().to(device),
            depths=torch.ones(1, device=device),
            opacities=torch.full((1,), 0.1, device=device),
            radii=torch.full((1, 2), 20_000, dtype=one.radii.dtype, device=device),
        )
        for form in forms(device):
            _, alpha = composite(splats, torch.ones(1, 3, device=device), bin_splats(splats), form=form)  # type: ignore[arg-type]
            assert alpha.max() <= 0.1 + 1e-6, form
            drawn += int(alpha.max() > 0.05)
    assert drawn > count / 2


@pytest.mark.parametrize("broken", [False, True])
@pytest.mark.parametrize("sharpness", [0.0, 0.5])
@pytest.mark.parametrize("c", [4, 11])
def test_a_distance_beyond_float32_shows_nothing(device: str, c: int, sharpness: float, broken: bool):
    """Splats so narrow that the squared distance of a pixel overflows, with and without a channel to be left out."""
    splats, channels = random_splats(8, 60, 30, 30, device, sharpness=sharpness), random_channels(8, 60, c, device)
    narrow = torch.arange(60, device=device) % 3 == 0
    conics = torch.where(narrow[:, None], torch.tensor([3.4e38, 0.0, 3e-3], device=device), splats.conics)
    if broken:
        channels = torch.where(narrow[:, None], torch.full_like(channels, -torch.inf), channels)
    background = torch.full((c,), 0.5, device=device)
    without = replace(splats, radii=splats.radii * (~narrow)[:, None].int())
    poisoned = replace(splats, conics=conics)
    for form in forms(device):
        expected = composite(without, channels, bin_splats(without), background, form=form)  # type: ignore[arg-type]
        got = composite(poisoned, channels, bin_splats(poisoned), background, form=form)  # type: ignore[arg-type]
        for ours, other in zip(got, expected):
            assert torch.equal(ours, other), form
        for name, gradient in zip(NAMES, gradients(poisoned, channels, background, 8, form)):
            assert torch.isfinite(gradient).all(), f"{form}: {name}"
