"""Checks of compositing: every form against float64, values and gradients."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from reference.compositing import composite as composite_reference
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.compositing import composite
from scgs_warp.types import Splats

NAMES = ("means2d", "conics", "opacities", "channels", "background")


def forms(device: str) -> list[str]:
    return ["plain", "cpu"] if device == "cpu" else ["plain", "cuda"]


def random_channels(seed: int, n: int, c: int, device: str = "cpu") -> Tensor:
    return torch.rand(n, c, generator=torch.Generator().manual_seed(seed + 100)).to(device)


def weights_of(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed + 200))


def leaves(splats: Splats, channels: Tensor, background: Tensor, dtype: torch.dtype) -> tuple[Splats, list[Tensor]]:
    tensors = (splats.means2d, splats.conics, splats.opacities, channels, background)
    if dtype == torch.float64:
        tensors = tuple(t.cpu() for t in tensors)
    found = [t.detach().to(dtype, copy=True).requires_grad_() for t in tensors]
    return replace(splats, means2d=found[0], conics=found[1], opacities=found[2]), found


def assert_images_agree(image: Tensor, expected: Tensor, tolerance: float = 1e-5) -> None:
    """99.9 % of the pixels within the tolerance, none beyond 8e-3 (a threshold that flips moves one by 1 / 255)."""
    error = (image.cpu().double() - expected.cpu().double()).abs()
    assert torch.isfinite(image).all()
    if error.numel():
        assert error.max() <= 8e-3
        assert (error > tolerance).double().mean() <= 1e-3


def assert_rows_agree(name: str, got: Tensor, expected: Tensor, tolerance: float = 2e-3, share: float = 0.99) -> None:
    """Relative L2 per row, with a floor of 1e-6 of the tensor's norm; a flipped threshold may spoil a few rows."""
    got, expected = got.cpu().double(), expected.cpu().double()
    assert got.shape == expected.shape, name
    if got.numel() == 0:
        return
    got, expected = got.reshape(len(got), -1), expected.reshape(len(expected), -1)
    error = (got - expected).norm(dim=1) / (expected.norm(dim=1) + 1e-6 * expected.norm() + 1e-12)
    assert torch.isfinite(got).all(), name
    assert (error <= tolerance).double().mean() >= share, f"{name}: {error.max()}"
    assert (got - expected).norm() <= 1e-2 * expected.norm() + 1e-12, name


def gradients(splats: Splats, channels: Tensor, background: Tensor, seed: int, form: str | None) -> list[Tensor]:
    """Of a random linear function of image and alpha; ``form`` None is the float64 twin."""
    tiles = bin_splats(splats)
    own, found = leaves(splats, channels, background, torch.float64 if form is None else torch.float32)
    if form is None:
        image, alpha = composite_reference(own, found[3], tiles, found[4])
    else:
        image, alpha = composite(own, found[3], tiles, found[4], form=form)  # type: ignore[arg-type]
    v_image, v_alpha = weights_of(seed, *image.shape).to(image), weights_of(seed + 1, *alpha.shape).to(image)
    ((image * v_image).sum() + (alpha * v_alpha).sum()).backward()
    return [t.grad if t.grad is not None else torch.zeros_like(t) for t in found]


def check(splats: Splats, channels: Tensor, seed: int, device: str, background: Tensor | None = None) -> None:
    if background is None:
        background = torch.linspace(0.2, 0.9, channels.shape[1], device=device)
    tiles = bin_splats(splats)
    expected, expected_alpha = composite_reference(splats, channels, tiles, background)
    expected_gradients = gradients(splats, channels, background, seed, None)
    for form in forms(device):
        image, alpha = composite(splats, channels, tiles, background, form=form)  # type: ignore[arg-type]
        assert image.device.type == device and image.shape == expected.shape
        assert_images_agree(image, expected)
        assert_images_agree(alpha, expected_alpha)
        for name, got, wanted in zip(NAMES, gradients(splats, channels, background, seed, form), expected_gradients):
            assert_rows_agree(f"{form}: {name}", got, wanted)
