"""Random networks of a shape: inputs of position and of time, hidden widths, layers that read the inputs again, and
outputs."""

from __future__ import annotations

import torch
from torch import Tensor


def parameters(shape: tuple, seed: int) -> tuple[list[Tensor], list[Tensor]]:
    """Make weights and biases of the size that training begins with."""
    where, when, widths, skips, out = shape
    random = torch.Generator().manual_seed(seed)
    weights, biases, before = [], [], 0
    for layer, width in enumerate([*widths, out]):
        columns = before + (where + when if layer == 0 or layer in skips else 0)
        weights.append((torch.randn(width, columns, generator=random) * (2.0 / columns) ** 0.5).requires_grad_())
        biases.append((0.1 * torch.randn(width, generator=random)).requires_grad_())
        before = width
    return weights, biases


def rows(shape: tuple, positions: int, times: int, seed: int) -> tuple[Tensor, Tensor]:
    """Make the inputs of some positions and times."""
    random = torch.Generator().manual_seed(seed + 100)
    return torch.randn(positions, shape[0], generator=random), torch.randn(times, shape[1], generator=random)
