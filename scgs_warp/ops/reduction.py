"""Column sums in an order that depends on the shape alone; torch does not guarantee one for ``tensor.sum(0)``."""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels import reduction as kernels
from ..runtime.launch import launch


def sum_rows(values: Tensor) -> Tensor:
    """Sum ``values`` [N, C], float32, over its rows to [C], as a tree with 64 children per node. No gradient."""
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
