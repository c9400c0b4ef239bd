"""Splats to tiles on CUDA: one radix sort of all pairs."""

from __future__ import annotations

import contextlib

import torch
import warp as wp
from torch import Tensor

from ..kernels import binning as kernels
from ..kernels import binning_cuda as cuda_kernels
from ..warp_interop import launch, warp_view

MAX_PAIRS = 2**31 - 1


def bin_by_radix(geometry: list[Tensor], size: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The same by one radix sort of all pairs, which a GPU can share among its threads."""
    count, tile_count, device = len(geometry[0]), size[2] * size[3], geometry[0].device
    counts, corners = (torch.empty(count, dtype=torch.int32, device=device) for _ in range(2))
    windows = torch.empty(count, dtype=torch.int64, device=device)
    launch(kernels.count_tiles, count, *geometry, *size, counts, corners, windows, None, None)
    offsets = torch.zeros(count + 1, dtype=torch.int64, device=device)
    torch.cumsum(counts, 0, out=offsets[1:])
    pairs = pair_total(offsets, MAX_PAIRS // 2)  # the sort's lists are twice as long
    tiles, owners, splats = (torch.empty(pairs, dtype=torch.int32, device=device) for _ in range(3))
    keys = torch.empty(2 * pairs, dtype=torch.int64, device=device)
    slots = torch.empty(2 * pairs, dtype=torch.int32, device=device)
    launch(kernels.emit_pairs, count, *geometry, offsets, corners, windows, *size, tiles)
    launch(cuda_kernels.pair_keys, count, geometry[3], offsets, tiles, keys, slots, owners)
    # The sort is stable and slots ascend with the splat's index: equal depths are in the order of the index.
    radix_sort(keys, slots, pairs, 32 + (tile_count - 1).bit_length())
    launch(cuda_kernels.gather_owners, pairs, slots, owners, splats)
    ranges = torch.empty(tile_count, 2, dtype=torch.int32, device=device)
    launch(cuda_kernels.tile_ranges, tile_count, keys, pairs, ranges)
    return ranges, splats, slots[:pairs], offsets


def pair_total(offsets: Tensor, most: int) -> int:
    """Pairs in all, or a refusal of more than the lists can index."""
    pairs = int(offsets[-1])
    if pairs > most:
        raise ValueError(f"splats: {pairs} pairs of splat and tile, more than {most}; reduce the image or the splats")
    return pairs


def radix_sort(keys: Tensor, values: Tensor, count: int, bits: int) -> None:
    """Stable radix sort of the first halves; the second halves are scratch."""
    if count == 0:
        return
    stream = contextlib.nullcontext()
    if keys.is_cuda:
        stream = wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(keys.device)), sync_enter=False)
    with stream:
        wp.utils.radix_sort_pairs(warp_view(keys), warp_view(values), count, 0, bits)
