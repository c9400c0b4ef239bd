"""Windows of tiles, for images whose lists of splats do not fit into memory together.

A tile's list does not depend on what else is listed, so a window's pixels have the bits of the whole image's. Windows
are rows of tiles as long as one row fits, then parts of a row, in the end one tile. They follow the order of the tiles,
so that sums over a splat's slots continue from window to window in the order they have in one piece.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ..runtime import memory
from ..types import Splats

Window = tuple[int, int]
"""Tiles from begin to end; either whole rows or within one row."""

WINDOW_SHARE = 0.5
"""Share of the free memory that a window may fill, while it can be cut further: memory is not free again at once."""
REMEDY = "make the image smaller or use fewer Gaussians"


class ListSize(Protocol):
    """Size of the lists of a window, counted before they are allocated."""

    pairs: int
    """Number of pairs of splat and tile."""
    entries: int
    """Length of the longest list."""
    max_entries: int
    """Largest length that a list can index."""

    @property
    def list_bytes(self) -> int:
        """Bytes of the lists."""
        ...

    @property
    def scratch_bytes(self) -> int:
        """Bytes used only while the lists are made."""
        ...


@dataclass(frozen=True)
class Demand:
    """Memory that compositing takes beside the lists, in bytes."""

    fixed: int
    """Independent of the number of pairs: images, packed splats, gradients."""
    per_pair: int = 0
    """Per pair in the backward pass: a gradient slot."""

    def total(self, size: ListSize) -> int:
        """Bytes with the lists and their scratch memory."""
        return self.fixed + size.list_bytes + max(size.scratch_bytes, self.per_pair * size.pairs)


def fits(size: ListSize, demand: Demand, device: torch.device) -> bool:
    """Return whether everything can be listed and drawn at once."""
    return size.entries <= size.max_entries and memory.fits(demand.total(size), device)


def require_image(need: int, size: tuple[int, int], count: int, device: torch.device) -> None:
    """Refuse an image that does not fit whatever its lists, before its tiles are counted.

    Args:
        need: bytes that do not depend on the number of pairs.
        size: width and height.
        count: number of splats.

    Raises:
        NotEnoughMemory: with the figures.
    """
    memory.require(need, device, _named(size, count), REMEDY)


def _named(size: tuple[int, int], count: int) -> str:
    return f"an image of {size[0]} x {size[1]} with {count:,} Gaussians"


def require_lists(size: ListSize, device: torch.device) -> None:
    """Refuse lists that cannot be made in one piece, for callers that do not draw in windows.

    Raises:
        ValueError: the lists cannot be indexed.
        NotEnoughMemory: they do not fit.
    """
    if size.entries > size.max_entries:
        raise ValueError(
            f"splats: {size.pairs} pairs of splat and tile, more than {size.max_entries}; "
            "reduce the image or the splats"
        )
    need = size.list_bytes + size.scratch_bytes
    memory.require(need, device, f"splats: {size.pairs:,} pairs of splat and tile", REMEDY)


def cut(measure: Callable[[Window], ListSize], columns: int, rows: int, demand: Demand, splats: Splats) -> list[Window]:
    """Cut an image into windows that all fit, in the order of the tiles.

    Args:
        measure: counts the lists of a window.
        columns, rows: tiles of the image.

    Raises:
        NotEnoughMemory: the image itself, or one of its tiles, takes too much.
    """
    device, name = splats.means2d.device, _named((splats.width, splats.height), len(splats.means2d))
    room = memory.room(device)
    if demand.fixed > room:
        raise memory.refusal(demand.fixed, device, name, REMEDY, room)
    done: list[Window] = []
    waiting: list[Window] = [(0, columns * rows)]
    while waiting:
        window = begin, end = waiting.pop()
        size = measure(window)
        total = demand.total(size)
        single = end - begin == 1
        if size.entries <= size.max_entries and total <= demand.fixed + WINDOW_SHARE * (room - demand.fixed):
            done.append(window)
        elif single and size.entries <= size.max_entries and total <= room:
            done.append(window)
        elif single:
            tile = f"{name}: one tile of it, with {size.pairs:,} splats,"
            raise memory.refusal(total, device, tile, REMEDY, room)
        else:
            waiting += reversed(halves(window, columns))
    return done


def halves(window: Window, columns: int) -> tuple[Window, Window]:
    """Halve a window of two tiles or more, between rows or within its only row."""
    begin, end = window
    rows = (end - begin) // columns
    middle = begin + (rows // 2 * columns if rows > 1 else (end - begin) // 2)
    return (begin, middle), (middle, end)


def slot_bytes(tensors: tuple[Tensor, ...], width: int) -> int:
    """Bytes of a gradient slot of ``width`` columns; 0 if there will be no backward pass."""
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return 4 * width if wanted else 0
