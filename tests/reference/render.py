"""The whole rasteriser in float64: projection, lists of splats and compositing twins, one after the other."""

from __future__ import annotations

import torch
from torch import Tensor

from reference.compositing import composite
from reference.projection import Projected, project
from scgs_warp.types import Splats, Tiles

TILE = 16


def tile_lists(
    splats: Projected,
    width: int,
    height: int,
    crop: tuple[int, int, int, int] | None = None,
    sort_by: Tensor | None = None,
) -> Tiles:
    """Every splat in each tile its box of radii meets, nearest first; ``slots`` and ``offsets`` are not filled.

    Tiles that do not meet ``crop`` (x0, y0, x1, y1) stay empty. ``sort_by`` [N] replaces the depths as the order.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    x0, y0, x1, y1 = crop or (0, 0, width, height)
    order = torch.argsort(splats.depths.detach() if sort_by is None else sort_by, stable=True)
    order = order[splats.radii[order, 0] > 0]
    low = (splats.means2d.detach() - splats.radii)[order]
    high = (splats.means2d.detach() + splats.radii)[order]
    lists = []
    for row in range(rows):
        if row * TILE >= y1 or (row + 1) * TILE <= y0:
            lists += [order[:0]] * columns
            continue
        meets = (high[:, 1] >= row * TILE) & (low[:, 1] <= (row + 1) * TILE)
        own, own_low, own_high = order[meets], low[meets, 0], high[meets, 0]
        for column in range(columns):
            wanted = column * TILE < x1 and (column + 1) * TILE > x0
            lists.append(own[(own_high >= column * TILE) & (own_low <= (column + 1) * TILE)] if wanted else own[:0])
    ends = torch.tensor([len(x) for x in lists]).cumsum(0)
    ranges = torch.stack([ends - torch.tensor([len(x) for x in lists]), ends], dim=1).int()
    none = torch.empty(0, dtype=torch.int32)
    return Tiles(ranges, torch.cat(lists).int(), none, none.long(), width, height, columns, rows, TILE)


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    background: Tensor | None = None,
    crop: tuple[int, int, int, int] | None = None,
    sort_by: Tensor | None = None,
    **options,
) -> tuple[Tensor, Tensor, Projected]:
    """Image [D + 1, h, w] whose last channel is the accumulated depth, alpha [h, w], and the splats. All on the CPU.

    Two depths may be equal to float32 and not to float64; then the order is a matter of rounding, and ``sort_by`` [N]
    (the float32 depths) makes this twin take the same one.
    """
    splats = project(means, quats, scales, opacities, viewmat, K, width, height, **options)
    channels = torch.cat([colors, splats.depths[:, None]], dim=1)
    if background is not None:
        background = torch.cat([background, background.new_zeros(1)])
    tiles = tile_lists(splats, width, height, crop, sort_by)
    seen = Splats(*splats, width, height, options.get("sharpness", 0.0))
    image, alpha = composite(seen, channels, tiles, background, crop=crop)
    return image, alpha, splats
