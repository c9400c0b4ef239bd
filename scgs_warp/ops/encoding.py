"""Positional encoding of every position at every time, in one launch and without gradients."""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels import encoding as kernels
from ..runtime.launch import launch


def encode_rows(positions: Tensor, times: Tensor, position_frequencies: int, time_frequencies: int) -> Tensor:
    """Encode positions [M, 3] and times [T]: row t M + m has x, sin and cos of 2^k x for the position, then the time.

    Returns:
        [T M, 3 (1 + 2 F) + 1 + 2 G] for F and G frequencies; columns are ordered by part, then by coordinate.
    """
    columns = 3 * (1 + 2 * position_frequencies) + 1 + 2 * time_frequencies
    rows = torch.empty(len(times) * len(positions), columns, device=positions.device)
    inputs = positions.detach().contiguous(), times.detach().float().contiguous()
    launch(kernels.encode, rows.numel(), *inputs, position_frequencies, time_frequencies, columns, rows)
    return rows
