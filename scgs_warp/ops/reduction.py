"""Column sums in an order fixed by the shape alone, whatever the thread count: ``tensor.sum(0)`` promises no order."""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels import reduction as kernels
from ..runtime.launch import launch


def sum_rows(values: Tensor) -> Tensor:
    """Sum of the rows of ``values`` [N, C], float32, as [C]; a tree of 64 children a node. No gradient."""
    if values.ndim != 2:
        raise ValueError(f"values must be [N, C], got {tuple(values.shape)}")
    if values.shape[0] == 0:
        return values.new_zeros(values.shape[1])
    values = values.detach().contiguous()
    while values.shape[0] > 1:
        groups = -(-values.shape[0] // int(kernels.ROWS))
        sums = torch.empty(groups, values.shape[1], dtype=values.dtype, device=values.device)
        launch(kernels.sum_rows, groups * values.shape[1], values, sums)
        values = sums
    return values[0]
