"""The photometric loss on a GPU, as an autograd function: two launches for the loss and one for its gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..kernels.cuda import ssim as kernels
from ..kernels.types import SSIM_TILE_COLUMNS, SSIM_TILE_ROWS
from . import cuda_blocks


def tile_count(image: Tensor) -> int:
    """Return the number of tiles in all channels of an image [C, H, W]."""
    channels, height, width = image.shape
    return channels * -(-height // SSIM_TILE_ROWS) * -(-width // SSIM_TILE_COLUMNS)


class PhotometricTiles(torch.autograd.Function):
    """Arguments and results of ``ssim.photometric_loss``, which checks them; weights are those of SSIM and logarithm.

    ``forward`` raises RuntimeError if the tensors are on a CPU.
    """

    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        truth: Tensor,
        mask: Tensor | None,
        weights: tuple[float, float],
        needs_gradient: bool,
    ) -> tuple[Tensor, Tensor, Tensor]:
        image, truth = image.detach().contiguous(), truth.contiguous()
        mask = None if mask is None else mask.contiguous()
        partials = image.new_empty(3, *image.shape) if needs_gradient else None
        count = tile_count(image)
        sums, results, slopes = image.new_empty(count, 4), image.new_empty(3), image.new_empty(2)
        cuda_blocks.launch_native(kernels.photometric, count, image, truth, mask, sums, partials)
        cuda_blocks.launch_native(kernels.photometric_total, 1, sums, *weights, results, slopes)
        ctx.save_for_backward(image, truth, mask, partials, slopes)
        ctx.ssim_weight = weights[0]
        ctx.set_materialize_grads(False)
        return results[0], results[1], results[2]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        image, truth, mask, partials, slopes = ctx.saved_tensors
        v_image = torch.empty_like(image)
        v_results = (None if v is None else v.reshape(1) for v in gradients)
        cuda_blocks.launch_native(
            kernels.photometric_adjoint,
            tile_count(image),
            *(image, truth, mask, partials, slopes, *v_results),
            *(ctx.ssim_weight, v_image),
        )
        return v_image, None, None, None, None
