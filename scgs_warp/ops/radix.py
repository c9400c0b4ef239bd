"""Stable radix sort of keys with values on torch's current stream, without host contact."""

from __future__ import annotations

import contextlib

import warp as wp
from torch import Tensor

from ..runtime.cuda_graph import on_torch_stream
from ..runtime.launch import warp_view


def radix_sort(keys: Tensor, values: Tensor, count: int, bits: int) -> None:
    """Sort the first halves of the tensors by key, stably; the second halves are scratch memory.

    Args:
        keys: [2 count] int32 or float32 on any device.
        values: [2 count] int32, on the same device.
        count: number of keys; 0 does nothing.
        bits: number of low bits of the keys that are compared; 0 leaves the order as it is.

    Raises:
        RuntimeError: Warp's sort failed on a GPU.
    """
    if count == 0:
        return
    with on_torch_stream(keys.device) if keys.is_cuda else contextlib.nullcontext():
        wp.utils.radix_sort_pairs(warp_view(keys), warp_view(values), count, 0, bits)
