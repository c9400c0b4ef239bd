"""Splats to tiles: which splats touch which tile, nearest first."""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels import binning as kernels
from ..kernels.types import TILE_SIZE
from ..types import Splats, Tiles
from ..warp_interop import launch
from .binning_cuda import MAX_PAIRS, bin_by_radix, pair_total, radix_sort


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

    lists = _bin_by_counting if device.type == "cpu" else bin_by_radix
    ranges, sorted_splats, slots, offsets = lists(geometry, size)
    return Tiles(ranges, sorted_splats, slots, offsets, splats.width, splats.height, columns, rows, tile_size)


def _bin_by_counting(geometry: list[Tensor], size: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Ranges, splats, slots, offsets, on a CPU: splats sorted by depth once, their pairs put in place tile by tile."""
    count, tile_count = len(geometry[0]), size[2] * size[3]
    counts, corners = (torch.empty(count, dtype=torch.int32) for _ in range(2))
    windows = torch.empty(count, dtype=torch.int64)
    depth_keys, order = torch.empty(2 * count), torch.empty(2 * count, dtype=torch.int32)
    launch(kernels.count_tiles, count, *geometry, *size, counts, corners, windows, depth_keys, order)
    offsets = torch.empty(count + 1, dtype=torch.int64)
    launch(kernels.scan_counts, 1, counts, offsets)
    pairs = pair_total(offsets, MAX_PAIRS)
    radix_sort(depth_keys, order, count, 32)
    tiles, splats, slots = (torch.empty(pairs, dtype=torch.int32) for _ in range(3))
    launch(kernels.emit_pairs, count, *geometry, offsets, corners, windows, *size, tiles)
    cursors = torch.empty(tile_count, dtype=torch.int32)
    ranges = torch.empty(tile_count, 2, dtype=torch.int32)
    launch(kernels.place_pairs, 1, order, offsets, tiles, cursors, ranges, splats, slots)
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
