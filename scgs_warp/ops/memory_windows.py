"""Images whose lists of splats do not fit into memory, in windows of tiles, each of which does.

A tile's list does not depend on what else is listed, so a window's pixels have the bits of the whole image's. Windows
are rows of tiles as long as one row fits, then parts of a row, in the end one tile. Their order is that of the tiles:
sums over a splat's slots go on from window to window in the order they have in one piece.
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

CROWDED = 0.5
"""Part of the memory that a window is cut to, while it can be cut: what one leaves behind is not at once free."""
REMEDY = "make the image smaller or use fewer Gaussians"


class Count(Protocol):
    """What counting found, before anything of the size of the lists is allocated."""

    pairs: int
    """Of splat and tile."""
    entries: int
    """Of the longest list."""
    most: int
    """What a list can index."""

    @property
    def kept(self) -> int:
        """Bytes of the lists."""
        ...

    @property
    def scratch(self) -> int:
        """Bytes that making them takes besides, and leaves free."""
        ...


@dataclass(frozen=True)
class Demand:
    """What compositing takes beside the lists, in bytes."""

    fixed: int
    """Whatever the number of pairs: images, packed splats, gradients."""
    per_pair: int = 0
    """In the backward pass: a gradient slot."""

    def total(self, count: Count) -> int:
        """With the lists and their scratch."""
        return self.fixed + count.kept + max(count.scratch, self.per_pair * count.pairs)


def fits(count: Count, demand: Demand, device: torch.device) -> bool:
    """Whether everything can be listed and drawn at once."""
    return count.entries <= count.most and memory.fits(demand.total(count), device)


def require_image(need: int, size: tuple[int, int], count: int, device: torch.device) -> None:
    """Refuse an image that itself does not fit, before its tiles are counted.

    Args:
        need: bytes whatever the number of pairs.
        size: width and height.
        count: of splats.

    Raises:
        NotEnoughMemory: with the figures.
    """
    memory.require(need, device, _named(size, count), REMEDY)


def _named(size: tuple[int, int], count: int) -> str:
    return f"an image of {size[0]} x {size[1]} with {count:,} Gaussians"


def require_lists(count: Count, device: torch.device) -> None:
    """Refuse lists that cannot be: there is nobody who would draw them in windows.

    Raises:
        ValueError: they cannot be indexed.
        NotEnoughMemory: they do not fit.
    """
    if count.entries > count.most:
        raise ValueError(
            f"splats: {count.pairs} pairs of splat and tile, more than {count.most}; reduce the image or the splats"
        )
    memory.require(count.kept + count.scratch, device, f"splats: {count.pairs:,} pairs of splat and tile", REMEDY)


def cut(count: Callable[[Window], Count], columns: int, rows: int, demand: Demand, splats: Splats) -> list[Window]:
    """Windows of an image that does not fit in one piece, in the order of the tiles, all of which fit.

    Args:
        count: of a window.
        columns, rows: tiles of the image.

    Raises:
        NotEnoughMemory: the image itself, or one of its tiles, takes too much.
    """
    device, name = splats.means2d.device, _named((splats.width, splats.height), len(splats.means2d))
    room = memory.room(device)
    if demand.fixed > room:
        raise memory.refusal(demand.fixed, device, name, REMEDY, room)
    found: list[Window] = []
    waiting: list[Window] = [(0, columns * rows)]
    while waiting:
        window = begin, end = waiting.pop()
        counted = count(window)
        total = demand.total(counted)
        single = end - begin == 1
        if counted.entries <= counted.most and total <= demand.fixed + CROWDED * (room - demand.fixed):
            found.append(window)
        elif single and counted.entries <= counted.most and total <= room:
            found.append(window)
        elif single:
            tile = f"{name}: one tile of it, with {counted.pairs:,} splats,"
            raise memory.refusal(total, device, tile, REMEDY, room)
        else:
            waiting += reversed(halves(window, columns))
    return found


def halves(window: Window, columns: int) -> tuple[Window, Window]:
    """Rows apart, or the columns of one row; the window has two tiles at least."""
    begin, end = window
    rows = (end - begin) // columns
    middle = begin + (rows // 2 * columns if rows > 1 else (end - begin) // 2)
    return (begin, middle), (middle, end)


def slot_bytes(tensors: tuple[Tensor, ...], width: int) -> int:
    """Of a gradient slot of ``width`` columns, if there will be a backward pass."""
    wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return 4 * width if wanted else 0
