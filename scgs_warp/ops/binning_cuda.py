"""Binning on CUDA: a radix sort of the splats by depth, then one of all pairs by tile.

``RadixBinning`` asks the device once for the number of pairs. ``bin_within`` never asks: it has room for a given number
of pairs and leaves the true number on the device. Both also run on a CPU, where they are tested.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels import falloff
from ..kernels.cuda import binning as kernels
from ..kernels.types import TILE_SIZE
from ..runtime import debug
from ..runtime.launch import launch
from ..types import Splats, Tiles
from . import checks, radix

MAX_PAIRS = 2**31 - 1
MAX_ROOM = MAX_PAIRS // 2
"""Largest number of pairs in a radix sort, whose lists are twice as long and indexed by int32."""


def bin_within(splats: Splats, capacity: int, *, slots: bool = True) -> tuple[Tiles, Tensor]:
    """Bin splats without waiting for the device: the size of every buffer follows from the arguments.

    Args:
        splats: N projected Gaussians, on any device; shapes are not checked.
        capacity: number of pairs of splat and tile that the lists hold, at least 1.
        slots: whether to make ``Tiles.slots``, which compositing needs for gradients only; otherwise it is empty.

    Returns:
        Tiles whose lists have ``capacity`` entries (without slots, ``Tiles.offsets`` is empty, too), and the true
        number of pairs, int64 [1] on the device. If it is
        larger than ``capacity``, pairs are missing from the lists (nothing is out of bounds) and an image drawn with
        them must be discarded.

    Raises:
        ValueError: the capacity is less than 1 or more than ``MAX_ROOM``.
    """
    if not 1 <= capacity <= MAX_ROOM:
        raise ValueError(f"capacity must be in 1 .. {MAX_ROOM}, got {capacity}")
    columns, rows = -(-splats.width // TILE_SIZE), -(-splats.height // TILE_SIZE)
    size = (splats.width, splats.height, columns, rows, TILE_SIZE)
    geometry = geometry_of(splats)
    whole = (*size, 0, columns * rows)
    counts, order = _count(geometry, whole)
    ranked = _ranked(counts, order)
    offsets = counts.cumsum(0).clamp_(max=capacity) if slots else ranked[:0]
    lists = _list(geometry, whole, ranked, order, offsets, capacity, slots)
    tiles = Tiles(*lists, offsets, *size)
    if debug.enabled():
        checks.check_room(tiles, capacity, len(geometry[0]))
    return tiles, ranked[-1:]


class RadixBinning:
    """Binning on a GPU (a ``ListSize``), with lists of exact length, for which the host waits once for the device."""

    max_entries = MAX_ROOM

    def __init__(self, geometry: list[Tensor], size: tuple[int, ...], window: tuple[int, int]) -> None:
        self._geometry, self._size = geometry, (*size, *window)
        self._counts, self._order = _count(geometry, self._size)
        self._offsets = self._counts.cumsum(0)
        self.pairs = self.entries = int(self._offsets[-1])

    @property
    def list_bytes(self) -> int:
        return 12 * self.pairs + 8 * len(self._offsets) + 8 * self._size[2] * self._size[3]

    @property
    def scratch_bytes(self) -> int:
        return 16 * self.pairs + 12 * len(self._counts)

    def lists(self, with_slots: bool = True) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return ranges, splats, slots (or [0]) and offsets."""
        ranked = _ranked(self._counts, self._order)
        lists = _list(self._geometry, self._size, ranked, self._order, self._offsets, self.pairs, with_slots)
        return *lists, self._offsets


def bytes_within(capacity: int, count: int, tiles: int) -> int:
    """Return the number of bytes that ``bin_within`` allocates without slots, for ``count`` splats."""
    return 16 * capacity + 52 * count + 8 * tiles


def geometry_of(splats: Splats) -> list[Tensor]:
    """Return the tensors that decide which tiles a splat touches, in the kernels' order."""
    names = ("means2d", "conics", "opacities", "depths", "radii")
    geometry = [getattr(splats, name).detach().contiguous() for name in names]
    if splats.sharpness > 0.0:
        reaching = torch.empty_like(geometry[2])
        launch(falloff.reaching_opacities, len(reaching), geometry[2], splats.sharpness, reaching)
        geometry[2] = reaching
    return geometry


def _count(geometry: list[Tensor], size: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Return 0 and the number of tiles that each splat touches, [N + 1], and a list [2 N] that starts with the order by
    depth."""
    count, device = len(geometry[0]), geometry[0].device
    counts = (torch.empty if count else torch.zeros)(count + 1, dtype=torch.int32, device=device)
    depth_keys = torch.empty(2 * count, device=device)
    order = torch.empty(2 * count, dtype=torch.int32, device=device)
    launch(kernels.count_pairs, count, *geometry, *size, counts, depth_keys, order)
    radix.radix_sort(depth_keys, order, count, 32)
    return counts, order


def _ranked(counts: Tensor, order: Tensor) -> Tensor:
    """Return where the pairs of each splat by depth begin, and their total: exclusive prefix sums, [N + 1] int64."""
    ranked = (torch.empty_like if len(order) else torch.zeros_like)(counts)
    launch(kernels.counts_by_depth, len(counts) - 1, order, counts, ranked)
    return ranked.cumsum(0)


def _list(
    geometry: list[Tensor],
    size: tuple[int, ...],  # width, height, columns, rows, tile size, begin and end of the window
    places: Tensor,
    order: Tensor,
    offsets: Tensor,
    room: int,
    with_slots: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return ranges [T, 2], splats [room] and slots [room] (or [0])."""
    count, tile_count, device = len(places) - 1, size[2] * size[3], places.device
    tiles, values = (checks.unwritten(2 * room, device) for _ in range(2))
    owners = checks.unwritten(room, device) if with_slots else None
    lists = (order, places, room, offsets if with_slots else None)
    launch(kernels.fill_rest, room, places, tile_count, tiles, values, owners)
    launch(kernels.emit_by_depth, count, *geometry, *lists, *size, tiles, values, owners)
    radix.radix_sort(tiles, values, room, tile_count.bit_length())
    ranges = torch.empty(tile_count, 2, dtype=torch.int32, device=device)
    launch(kernels.tile_ranges, tile_count, tiles, room, ranges)
    if owners is None:
        return ranges, values[:room], values[:0]
    splats = torch.empty(room, dtype=torch.int32, device=device)
    launch(kernels.gather_owners, room, values, owners, splats)
    return ranges, splats, values[:room]
