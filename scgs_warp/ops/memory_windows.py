"""Windows of tiles: ranges that are listed and drawn one after the other if the whole image's lists exceed memory.

A tile's list does not depend on which other tiles are listed, so pixels drawn in windows are bit-identical to those
drawn at once. A window consists of whole rows of tiles if at least one row fits into memory, otherwise of a part of one
row. Windows follow the order of the tiles, so that sums over a splat's slots continue from window to window in the
order in which the whole image would add them.
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
"""Range of tiles (begin, end): either whole rows, or part of one row."""

WINDOW_SHARE = 0.5
"""Share of the free memory that a window may fill if it can be cut further: freed memory returns with a delay."""
REMEDY = "make the image smaller or use fewer Gaussians"


class ListSize(Protocol):
    """Size of a window's lists, computed before they are allocated."""

    pairs: int
    """Number of pairs of splat and tile."""
    entries: int
    """Length of the longest list."""
    max_entries: int
    """Largest length that a list can index."""

    @property
    def list_bytes(self) -> int:
        """Number of bytes of the lists."""
        ...

    @property
    def scratch_bytes(self) -> int:
        """Number of bytes used only while the lists are made."""
        ...


@dataclass(frozen=True)
class Demand:
    """Memory that compositing takes in addition to the lists, in bytes."""

    fixed: int
    """Bytes independent of the number of pairs: images, packed splats, gradients."""
    per_pair: int = 0
    """Bytes per pair in the backward pass: a gradient slot."""

    def total(self, size: ListSize) -> int:
        """Return the number of bytes including the lists and their scratch memory."""
        return self.fixed + size.list_bytes + max(size.scratch_bytes, self.per_pair * size.pairs)


def fits(size: ListSize, demand: Demand, device: torch.device) -> bool:
    """Return whether all tiles counted in ``size`` can be listed and drawn at once."""
    return size.entries <= size.max_entries and memory.fits(demand.total(size), device)


def require_image(need: int, size: tuple[int, int], count: int, device: torch.device) -> None:
    """Refuse an image that does not fit even without its lists, before its tiles are counted.

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
        measure: function that returns the size of a window's lists.
        columns, rows: numbers of tiles in the image.

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
    """Return the bytes of a gradient slot of ``width`` columns; 0 if there will be no backward pass."""
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return 4 * width if wanted else 0
