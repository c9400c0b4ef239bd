"""Splats to tiles: which splats touch which tile, nearest first."""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels import binning_cpu as kernels
from ..kernels.types import TILE_SIZE
from ..types import Splats, Tiles
from ..warp_interop import launch
from .binning_cuda import MAX_PAIRS, bin_by_radix

CHUNK_SIZE = 1024
"""Fewest splats worth a chunk on a CPU."""
MAX_CHUNKS = 128
"""A chunk counts what it has in each row of tiles: with many chunks the counts outweigh the splats."""


def bin_splats(splats: Splats, tile_size: int = TILE_SIZE) -> Tiles:
    """List, for every tile of the image, the splats that reach one of its pixels, sorted by depth.

    A splat reaches the pixels where its alpha is at least 1/255. Splats with a radius of 0, non-finite or not positive
    definite values, or an opacity under 1/255 are left out. Equal depths are ordered by index. No gradient.

    Args:
        splats: N projected Gaussians, on any device.
        tile_size: side of a tile in pixels.

    Returns:
        Tiles on the same device; ``ranges`` row major, ``slots`` such that splat ``i`` owns ``offsets[i]`` up to
        ``offsets[i + 1]``, in the order rows first, then columns.

    Raises:
        ValueError: a field's shape does not fit, an image side or tile size is not positive, or there are more than
            2^31 - 1 pairs of splat and tile.
    """
    _validate(splats, tile_size)
    columns, rows = -(-splats.width // tile_size), -(-splats.height // tile_size)
    device = splats.means2d.device
    geometry = [
        getattr(splats, name).detach().contiguous() for name in ("means2d", "conics", "opacities", "depths", "radii")
    ]
    size = (splats.width, splats.height, columns, rows, tile_size)

    lists = _bin_by_bands if device.type == "cpu" else bin_by_radix
    ranges, sorted_splats, slots, offsets = lists(geometry, size)
    return Tiles(ranges, sorted_splats, slots, offsets, splats.width, splats.height, columns, rows, tile_size)


def _bin_by_bands(geometry: list[Tensor], size: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Ranges, splats, slots, offsets, on a CPU: what each splat touches is dealt to the rows of tiles, each of which is
    sorted by itself; see ``kernels.binning_cpu``."""
    count, (_, _, columns, rows, _) = len(geometry[0]), size
    chunk_size = max(CHUNK_SIZE, -(-count // (16 * MAX_CHUNKS)) * 16)
    chunks = max(-(-count // chunk_size), 1)
    windows, offsets = torch.empty(count, dtype=torch.int64), torch.empty(count + 1, dtype=torch.int64)
    corners, ranges = torch.empty(count, 2, dtype=torch.int32), torch.empty(rows * columns, 2, dtype=torch.int32)
    begins, before = (torch.empty(chunks, rows + 1, dtype=torch.int32) for _ in range(2))
    band_begins = torch.empty(rows + 1, dtype=torch.int32)
    first_slots = torch.empty(chunks + 2, dtype=torch.int64)

    found = (windows, corners)
    launch(kernels.count_chunks, chunks, *geometry, chunk_size, *size, *found, begins, first_slots, grain=1)
    launch(kernels.place_chunks, 1, begins, first_slots, band_begins)
    pairs, stretches = first_slots[chunks:].tolist()
    if max(pairs, stretches) > MAX_PAIRS:
        raise ValueError(f"splats: {pairs} pairs of splat and tile, more than {MAX_PAIRS}; reduce the image or them")
    keys, spare = (torch.empty(stretches, dtype=torch.int64) for _ in range(2))
    dealt = torch.empty(stretches, 4, dtype=torch.int32)
    lists = (offsets, dealt, keys, before)
    launch(kernels.deal_chunks, chunks, *geometry[:4], chunk_size, *size, *found, first_slots, begins, *lists, grain=1)
    splats, slots = (torch.empty(pairs, dtype=torch.int32) for _ in range(2))
    cursors = torch.empty(rows, columns, dtype=torch.int32)
    tiles = (cursors, ranges, splats, slots)
    launch(kernels.sort_bands, rows, band_begins, dealt, before, keys, spare, *tiles, grain=1, load=band_begins[1:])
    return ranges, splats, slots, offsets


def _validate(splats: Splats, tile_size: int) -> None:
    if splats.width < 1 or splats.height < 1 or tile_size < 1:
        raise ValueError(
            f"width, height and tile_size must be positive, got {splats.width}, {splats.height}, {tile_size}"
        )
    count = len(splats.means2d)
    for name, shape in (
        ("means2d", (count, 2)),
        ("conics", (count, 3)),
        ("opacities", (count,)),
        ("depths", (count,)),
        ("radii", (count, 2)),
    ):
        if tuple(getattr(splats, name).shape) != shape:
            raise ValueError(f"{name} must be {list(shape)}, got {list(getattr(splats, name).shape)}")
