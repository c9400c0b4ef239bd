"""Checks of the invariants between binning and compositing, for debug mode (``scgs_warp.runtime.debug``)."""

from __future__ import annotations

import torch
from torch import Tensor

from ..runtime import debug
from ..types import Splats, Tiles

UNWRITTEN = -1
"""Initial value of list entries in debug mode."""
UNWRITTEN_BITS = 0x7FABCDEF
"""Initial bits of gradient slots in debug mode: a NaN that arithmetic never produces."""
SAFE_MAGNITUDE = 1e30
"""Largest magnitude of values whose sums are certain to be finite."""


def unwritten(size: int, device: torch.device | str = "cpu") -> Tensor:
    """Allocate [size] int32 for a kernel to fill; debug mode can tell entries that the kernel leaves out."""
    if debug.enabled():
        return torch.full((size,), UNWRITTEN, dtype=torch.int32, device=device)
    return torch.empty(size, dtype=torch.int32, device=device)


def unwritten_slots(pairs: int, width: int, device: torch.device) -> Tensor:
    """Allocate [pairs, width] float32 for a kernel to fill, as :func:`unwritten` does."""
    slots = torch.empty(pairs, width, dtype=torch.float32, device=device)
    if debug.enabled():
        slots.view(torch.int32).fill_(UNWRITTEN_BITS)
    return slots


def expect(holds: bool | Tensor, what: str) -> None:
    """Check that the invariant described by ``what`` holds everywhere.

    Raises:
        BrokenInvariant: it does not.
    """
    if isinstance(holds, Tensor):
        holds = bool(holds.all())
    if not holds:
        raise debug.BrokenInvariant(f"violated: {what}")


def check_tiles(splats: Splats, tiles: Tiles) -> None:
    """Check complete lists: every counted pair is listed once, in its tile, in order, with a slot of its own.

    Raises:
        BrokenInvariant: an invariant is violated; the message names it.
    """
    count, pairs = len(splats.means2d), len(tiles.splats)
    check_room(tiles, pairs, count)
    listed, slots, offsets = tiles.splats.long(), tiles.slots.long(), tiles.offsets
    expect(len(slots) == pairs, "there are as many slots as pairs")
    if len(tiles.ranges):
        ends = torch.stack([tiles.ranges[0, 0], tiles.ranges[-1, 1]]).tolist()
        expect(ends == [0, pairs], "tile ranges cover the list")
        expect(tiles.ranges[1:, 0] == tiles.ranges[:-1, 1], "each tile's range begins where the last one ends")
    if count == 0:
        return
    expect(offsets[-1:] == pairs, "as many pairs are listed as were counted")
    emitted = torch.bincount(listed, minlength=count)
    expect(emitted == offsets.diff(), "of each Gaussian, as many pairs are emitted as were counted")
    expect(torch.bincount(slots, minlength=pairs) == 1, "no two pairs share a gradient slot")
    owned = (offsets[listed] <= slots) & (slots < offsets[listed + 1])
    expect(owned, "a pair's gradient slot is one of its Gaussian's")
    tile = torch.repeat_interleave(
        torch.arange(len(tiles.ranges), device=listed.device), (tiles.ranges[:, 1] - tiles.ranges[:, 0]).long()
    )
    depths = splats.depths.detach()[listed]
    ordered = (depths[:-1] < depths[1:]) | ((depths[:-1] == depths[1:]) & (listed[:-1] < listed[1:]))
    expect(ordered | (tile[:-1] != tile[1:]), "within a tile, pairs are sorted by depth, then index")


def check_dealt(begun: Tensor, ended: Tensor) -> None:
    """Check on a CPU that ``deal_chunks`` wrote every stretch that ``sort_bands`` will read.

    Args:
        begun, ended: [chunks, rows + 1] position of each chunk's first stretch in each row, and the position behind its
            last one.

    Raises:
        BrokenInvariant: a chunk wrote more or fewer stretches than it counted.
    """
    expect(begun.T.flatten()[1:] == ended.T.flatten()[:-1], "each chunk deals as many stretches as it counted")


def check_room(tiles: Tiles, capacity: int, count: int) -> None:
    """Check lists with room for ``capacity`` pairs of ``count`` splats; pairs that did not fit may be missing.

    Raises:
        BrokenInvariant: an entry points outside the lists.
    """
    ranges, offsets = tiles.ranges, tiles.offsets
    expect(len(tiles.splats) == capacity, "the list has the room that was planned")
    expect((tiles.splats >= 0) & (tiles.splats < max(count, 1)), "every place in the list was written")
    expect((tiles.slots >= 0) & (tiles.slots < capacity), "every gradient slot lies within their number")
    expect((ranges >= 0) & (ranges <= capacity), "tile ranges lie within the list")
    expect(ranges[:, 0] <= ranges[:, 1], "no tile range ends before it begins")
    expect(offsets[:1] == 0, "the first Gaussian's slots begin at 0")
    expect((offsets.diff() >= 0) & (offsets[1:] <= capacity), "Gaussians' slots follow each other within their number")


def check_pixels(tiles: Tiles, window: tuple[int, int], alpha: Tensor, transmittance: Tensor, last: Tensor) -> None:
    """Check the results of the forward pass for the pixels of a window of tiles.

    Args:
        alpha, transmittance, last: [H, W] of the whole image.

    Raises:
        BrokenInvariant: an invariant is violated; the message names it.
    """
    side, device = tiles.tile_size, alpha.device
    rows = torch.arange(tiles.height, device=device) // side
    columns = torch.arange(tiles.width, device=device) // side
    tile = rows[:, None] * tiles.columns + columns
    inside = (tile >= window[0]) & (tile < window[1])
    span, last = tiles.ranges[tile[inside]], last[inside]
    left = transmittance[inside]
    expect((left >= 0.0) & (left <= 1.0), "final transmittance lies in [0, 1]")
    expect((alpha[inside] >= 0.0) & (alpha[inside] <= 1.0), "alpha lies in [0, 1]")
    reached = (last > span[:, 0]) & (last <= span[:, 1])
    expect(reached | (last == 0), "the last contributor is one of its tile's splats")


def check_image(image: Tensor, channels: Tensor, background: Tensor) -> None:
    """Check that an image drawn from finite colours is finite.

    Raises:
        BrokenInvariant: it is not.
    """
    finite = channels[channels.isfinite()]
    if _safe(finite, background):
        expect(image.isfinite(), "an image of finite colours is finite")


def check_slots(tiles: Tiles, v_slots: Tensor) -> None:
    """Check that each pair has a gradient slot and that every slot was written.

    Raises:
        BrokenInvariant: a slot is missing, or would be read without having been written.
    """
    expect(len(v_slots) == len(tiles.splats), "there is a gradient slot for each pair")
    left = (v_slots.view(torch.int32) == UNWRITTEN_BITS).any(dim=1)
    expect(~left, "every gradient slot was written before it is read")


def check_gradients(gradients: tuple[Tensor | None, ...], v_image: Tensor, v_alpha: Tensor | None) -> None:
    """Check that finite incoming gradients give finite gradients.

    Raises:
        BrokenInvariant: they do not.
    """
    if _safe(v_image, *([] if v_alpha is None else [v_alpha])):
        for gradient in gradients:
            expect(gradient is None or gradient.isfinite(), "gradients of finite gradients are finite")


def _safe(*tensors: Tensor) -> bool:
    """Return whether all values are finite and small enough for finite sums."""
    return all(bool((tensor.abs() <= SAFE_MAGNITUDE).all()) for tensor in tensors)
