"""Binning: lists of the splats that touch each tile, nearest first."""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels.cpu import binning as kernels
from ..kernels.types import TILE_SIZE
from ..runtime import debug
from ..runtime.launch import launch
from ..types import Splats, Tiles
from . import checks, memory_windows
from .binning_cuda import MAX_PAIRS, RadixBinning, geometry_of
from .memory_windows import Demand, Window
from .shapes import check_shapes

CHUNK_SIZE = 1024
"""Smallest number of splats that a chunk holds on a CPU."""
MAX_CHUNKS = 128
"""Largest number of chunks. Each keeps a count per row of tiles, and the counts must not outweigh the splats."""


def bin_splats(
    splats: Splats, tile_size: int = TILE_SIZE, *, demand: Demand | None = None, slots: bool = True
) -> Tiles:
    """List, for every tile of the image, the splats that reach one of its pixels, sorted by depth.

    A splat reaches the pixels where its alpha is at least 1/255. A splat is left out if its radius is 0, a value is
    non-finite, its conic is not positive definite, or its opacity is under 1/255. Equal depths are ordered by index. No
    gradient.

    Args:
        splats: N projected Gaussians, on any device.
        tile_size: side of a tile in pixels.
        demand: memory that compositing takes in addition to the lists. If given, an image whose lists do not fit into
            memory is cut into windows, which ``composite`` draws one after the other. None: the lists have to fit.
        slots: whether to make ``Tiles.slots``, which compositing needs for gradients only; otherwise it is empty,
            except in debug mode.

    Returns:
        Tiles on the same device, with ``ranges`` in row-major order. Splat ``i`` owns the slots ``offsets[i]`` up to
        ``offsets[i + 1]``, one per tile it touches, in row-major order.

    Raises:
        ValueError: a field has a wrong shape, an image side or tile size is not positive, or there are more than
            2^31 - 1 tiles or (without ``demand``) pairs of splat and tile.
        NotEnoughMemory: the lists, or with ``demand`` the image or a single tile, take more memory than is free.
    """
    _validate(splats, tile_size)
    columns, rows = -(-splats.width // tile_size), -(-splats.height // tile_size)
    size = (splats.width, splats.height, columns, rows, tile_size)
    device, whole = splats.means2d.device, (0, columns * rows)
    if demand is not None:
        memory_windows.require_image(demand.fixed, (splats.width, splats.height), len(splats.means2d), device)
    if columns * rows > MAX_PAIRS:
        raise ValueError(f"splats: an image of {columns * rows} tiles, more than {MAX_PAIRS}; reduce the image")
    count = _count(splats, size, whole)
    if demand is None:
        memory_windows.require_lists(count, device)
    elif not memory_windows.fits(count, demand, device):
        windows = memory_windows.cut(lambda window: _count(splats, size, window), columns, rows, demand, splats)
        empty = torch.empty(0, dtype=torch.int32, device=device)
        return Tiles(empty.view(0, 2), empty, empty, empty.long(), *size, windows=tuple(windows))
    return _listed(splats, size, count, slots)


def bin_window(splats: Splats, tiles: Tiles, window: Window) -> Tiles:
    """List the splats of a window of tiles; the lists of all other tiles are empty.

    Args:
        tiles: result of ``bin_splats`` for the same splats.
        window: begin and end of the range of tiles to list.
    """
    size = (tiles.width, tiles.height, tiles.columns, tiles.rows, tiles.tile_size)
    return _listed(splats, size, _count(splats, size, window))


def _count(splats: Splats, size: tuple[int, ...], window: Window) -> BandBinning | RadixBinning:
    counted = BandBinning if splats.means2d.device.type == "cpu" else RadixBinning
    return counted(geometry_of(splats), size, window)


def _listed(
    splats: Splats, size: tuple[int, int, int, int, int], count: BandBinning | RadixBinning, slots: bool = True
) -> Tiles:
    tiles = Tiles(*count.lists(slots or debug.enabled()), *size)
    if debug.enabled():
        checks.check_tiles(splats, tiles)
    return tiles


class BandBinning:
    """Binning on a CPU (a ``ListSize``): splats are distributed to rows of tiles, and each row is sorted separately.

    See ``kernels.cpu.binning``."""

    max_entries = MAX_PAIRS

    def __init__(self, geometry: list[Tensor], size: tuple[int, ...], window: Window) -> None:
        count, (_, _, columns, rows, _) = len(geometry[0]), size
        self._geometry, self._size, self._tiles = geometry, (*size, *window), (rows, columns)
        self._chunk_size = max(CHUNK_SIZE, -(-count // (16 * MAX_CHUNKS)) * 16)
        self._chunks = chunks = max(-(-count // self._chunk_size), 1)
        windows = torch.empty(count, dtype=torch.int64)
        corners = torch.empty(count, 2, dtype=torch.int32)
        self._touched = (windows, corners)
        self._begins = torch.empty(chunks, rows + 1, dtype=torch.int32)
        self._band_begins = torch.empty(rows + 1, dtype=torch.int32)
        self._first_slots = torch.empty(chunks + 2, dtype=torch.int64)
        counts = (*self._touched, self._begins, self._first_slots)
        launch(kernels.count_chunks, chunks, *geometry, self._chunk_size, *self._size, *counts, grain=1)
        launch(kernels.place_chunks, 1, self._begins, self._first_slots, self._band_begins)
        self.pairs, self._stretches = self._first_slots[chunks:].tolist()
        self.entries = max(self.pairs, self._stretches)

    @property
    def list_bytes(self) -> int:
        rows, columns = self._tiles
        return 8 * self.pairs + 8 * len(self._geometry[0]) + 8 * rows * columns

    @property
    def scratch_bytes(self) -> int:
        rows, columns = self._tiles
        return 32 * self._stretches + 4 * self._begins.numel() + 4 * rows * columns

    def lists(self, with_slots: bool = True) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return ranges, splats, slots (or [0]) and offsets."""
        count, (rows, columns) = len(self._geometry[0]), self._tiles
        offsets = torch.empty(count + 1, dtype=torch.int64)
        keys, spare = (torch.empty(self._stretches, dtype=torch.int64) for _ in range(2))
        dealt = torch.empty(self._stretches, 4, dtype=torch.int32)
        before = torch.empty_like(self._begins)
        begun = self._begins.clone() if debug.enabled() else None
        chunks = (*self._touched, self._first_slots, self._begins, offsets, dealt, keys, before)
        launch(kernels.deal_chunks, self._chunks, *self._geometry[:4], self._chunk_size, *self._size, *chunks, grain=1)
        if begun is not None:
            checks.check_dealt(begun, self._begins)
        ranges = torch.empty(rows * columns, 2, dtype=torch.int32)
        splats, slots = checks.unwritten(self.pairs), checks.unwritten(self.pairs if with_slots else 0)
        cursors = torch.empty(rows, columns, dtype=torch.int32)
        tiles, load = (cursors, ranges, splats, slots), self._band_begins[1:]
        launch(kernels.sort_bands, rows, self._band_begins, dealt, before, keys, spare, *tiles, grain=1, load=load)
        return ranges, splats, slots, offsets


def _validate(splats: Splats, tile_size: int) -> None:
    if splats.width < 1 or splats.height < 1 or tile_size < 1:
        raise ValueError(
            f"width, height and tile_size must be positive, got {splats.width}, {splats.height}, {tile_size}"
        )
    count = len(splats.means2d)
    expected = {
        "means2d": (splats.means2d, (count, 2)),
        "conics": (splats.conics, (count, 3)),
        "opacities": (splats.opacities, (count,)),
        "depths": (splats.depths, (count,)),
        "radii": (splats.radii, (count, 2)),
    }
    check_shapes(expected)
