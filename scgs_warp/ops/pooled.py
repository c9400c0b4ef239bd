"""Residual of averaged images: the part of an error that no small displacement explains."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from ..runtime.environment import one_piece

SMALLEST = 0.02
"""Side of the smallest squares, as a share of the image's width."""
LEVELS = 3
"""Number of sizes; each doubles the side."""


def pooled_residual(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean absolute residual after averaging over squares, summed over three sizes of squares.

    Where a thin part is drawn beside its true place, both places have a residual, twice as much as if the part were not
    drawn. Averaged over squares larger than the displacement, only a part that is not drawn has a residual.

    Args:
        image, truth: [C, H, W] float32.
        mask: [H, W] bool, True where the pixel is valid. Other pixels have no residual.

    Returns:
        Scalar, differentiable in ``image``.
    """
    residual = image - truth if mask is None else (image - truth).where(mask, 0.0)
    with one_piece():
        side, total = max(1, round(SMALLEST * image.shape[2])), image.new_zeros(())
        pooled = residual[None]
        for _ in range(LEVELS):
            pooled = F.avg_pool2d(pooled, side, ceil_mode=True)
            total = total + pooled.abs().mean()
            side = 2
        return total
