"""Pooled residual: against float64, under masks, and its preference for a displaced part over a missing one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scgs_warp.ops.pooled import pooled_residual


def slow(image: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Average square by square in float64. Squares at the right and lower rims are cut off."""
    residual = image - truth
    if mask is not None:
        residual = torch.where(mask, residual, torch.zeros_like(residual))
    side, total = max(1, round(0.02 * image.shape[2])), torch.zeros((), dtype=torch.float64)
    for _ in range(3):
        rows = [
            torch.stack([part.mean(dim=(1, 2)) for part in band.split(side, dim=2)], dim=1)
            for band in residual.split(side, dim=1)
        ]
        residual = torch.stack(rows, dim=1)
        total = total + residual.abs().mean()
        side = 2
    return total


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("height", "width"), [(40, 200), (37, 101), (1, 30), (5, 7)])
def test_value_and_gradient_agree_with_float64(height, width, masked, device):
    random = torch.Generator().manual_seed(height)
    image, truth = (torch.rand(3, height, width, generator=random) for _ in range(2))
    mask = torch.rand(height, width, generator=random) < 0.7 if masked else None
    if mask is not None:
        image[:, ~mask] = float("nan")
    fast = image.clone().to(device).requires_grad_()
    found = pooled_residual(fast, truth.to(device), None if mask is None else mask.to(device))
    found.backward()
    exact = image.double().requires_grad_()
    expected = slow(exact, truth.double(), mask)
    expected.backward()
    assert float(found.detach()) == pytest.approx(float(expected.detach()), rel=1e-5)
    assert fast.grad is not None and exact.grad is not None
    known = np.nan_to_num(exact.grad.float().numpy())
    np.testing.assert_allclose(np.nan_to_num(fast.grad.cpu().numpy()), known, rtol=1e-4, atol=1e-7)


def test_a_part_beside_its_place_is_better_than_none():
    """Pixel by pixel, it is worse."""
    truth = torch.zeros(3, 200, 200)
    truth[:, 20:180, 100:102] = 1.0
    beside = truth.roll(3, dims=2)
    missing = torch.zeros_like(truth)
    assert float((beside - truth).abs().mean()) > float((missing - truth).abs().mean())
    assert float(pooled_residual(beside, truth)) < 0.7 * float(pooled_residual(missing, truth))
    assert float(pooled_residual(truth, truth)) == 0.0


def blob(x: float) -> torch.Tensor:
    """Draw a spot with a standard deviation of 2 pixels."""
    columns, rows = torch.arange(200.0), torch.arange(200.0)[:, None]
    return torch.exp(-((columns - x) ** 2 + (rows - 90.0) ** 2) / 8.0).expand(3, 200, 200)


def test_a_part_is_drawn_to_its_place_from_beyond_its_reach():
    """Pixel by pixel, the residual does not change. The mean over positions counts, because squares have borders."""
    places = [80.0 + 2.0 * i for i in range(16)]
    far, near = (sum(float(pooled_residual(blob(x - d), blob(x))) for x in places) for d in (16.0, 10.0))
    far_pixels, near_pixels = (float((blob(100.0 - d) - blob(100.0)).abs().mean()) for d in (16.0, 10.0))
    assert far_pixels == pytest.approx(near_pixels, rel=0.02)
    assert near < 0.9 * far, (near, far)
