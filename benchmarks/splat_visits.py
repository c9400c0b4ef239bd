"""How often a warp visits a splat when an image is composited, by this project's rules and by gsplat 1.5.3's.

A warp holds 32 pixels of a tile: here 8 x 4, in gsplat 16 x 2. Here it visits the splats whose bounding box reaches
its pixels, in gsplat all splats of the tile. A visit is a hit if some pixel uses the splat. All is counted exactly,
pixel by pixel, with one exception: a pixel is taken to close after the same share of gsplat's longer lists as of ours.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.projection import project
from scgs_warp.types import Camera, Gaussians, Splats, Tiles

ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN = 1.0 / 255.0, 0.999, 1e-4
TILE, WORD = 16, 32


class Visits(NamedTuple):
    """Rounds of the loops over splats, summed over all warps of an image."""

    pairs: int
    """Pairs of splat and tile in the lists."""
    forward: int
    backward: int
    hits: int
    """Visits in which some pixel of the warp uses the splat, the same in both passes."""


def count_visits(gaussians: Gaussians, camera: Camera) -> tuple[Visits, Visits]:
    """Count for an image what this project does, and what gsplat does."""
    geometry = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
    view = camera.viewmat, camera.K, camera.width, camera.height
    with torch.no_grad():
        splats = project(*geometry, *view, sharpness=gaussians.sharpness)
        tiles = bin_splats(splats)
        lengths = _rectangle_lengths(splats, tiles)
        ours, theirs = torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
        for tile in torch.nonzero(tiles.ranges[:, 1] > tiles.ranges[:, 0]).flatten().tolist():
            own, other = _tile_visits(splats, tiles, tile, int(lengths[tile]))
            ours, theirs = ours + own, theirs + other
    counts = [[round(float(value)) for value in sums] for sums in (ours, theirs)]
    return Visits(len(tiles.splats), *counts[0]), Visits(int(lengths.sum()), *counts[1])


def _rectangle_lengths(splats: Splats, tiles: Tiles) -> Tensor:
    """Return the number of splats that gsplat lists for each tile: those whose rectangle of radii touches it."""
    shown = (splats.radii > 0).all(1)
    means, radii = splats.means2d[shown] / TILE, splats.radii[shown] / TILE
    grid = torch.tensor([tiles.columns, tiles.rows])
    low = torch.minimum((means - radii).floor().long().clamp(min=0), grid)
    high = torch.minimum((means + radii).ceil().long().clamp(min=0), grid)
    corners = torch.zeros(tiles.rows + 1, tiles.columns + 1, dtype=torch.long)
    empty = ((high - low) <= 0).any(1)
    for x, y, sign in ((low, low, 1), (high, low, -1), (low, high, -1), (high, high, 1)):
        step = torch.where(empty, 0, sign)
        corners.index_put_((y[:, 1], x[:, 0]), step, accumulate=True)
    return corners.cumsum(0).cumsum(1)[:-1, :-1].flatten()


def _tile_visits(splats: Splats, tiles: Tiles, tile: int, length: int) -> tuple[Tensor, Tensor]:
    """Return forward visits, backward visits and hits of one tile, ours and gsplat's."""
    begin, end = tiles.ranges[tile].tolist()
    chosen = tiles.splats[begin:end].long()
    corner = torch.tensor([tile % tiles.columns, tile // tiles.columns]) * TILE
    used, closed_at = _used(splats, chosen, corner)
    results = []
    for warps in (_warps(8, 4), _warps(16, 2)):
        uses = used[:, warps].any(2)  # [n, 8]
        order = torch.arange(1, len(chosen) + 1)[:, None]
        last = (uses * order).amax(0)  # [8] the last contributor of a warp, + 1
        closes = closed_at[warps].amax(1)  # [8] rounds until all of its pixels are closed
        results.append((uses, order, last, closes))
    uses, order, last, closes = results[0]
    reached = _reached(splats, chosen, corner)
    words = (closes + WORD - 1) // WORD * WORD  # whether pixels are open is asked once in 32 splats
    ours = ((reached & (order <= words)).sum(), (reached & (order <= last)).sum(), uses.sum())
    uses, order, last, closes = results[1]
    share = length / len(chosen)
    theirs = ((closes * share).sum(), (last * share).sum(), uses.sum())
    return torch.tensor(ours, dtype=torch.float64), torch.tensor(theirs, dtype=torch.float64)


def _used(splats: Splats, chosen: Tensor, corner: Tensor) -> tuple[Tensor, Tensor]:
    """Return whether each splat is blended into each pixel, [n, 256], and the round in which a pixel closes, [256]."""
    index = torch.arange(TILE * TILE)
    pixels = torch.stack([index % TILE, index // TILE], 1) + corner + 0.5
    d = pixels - splats.means2d[chosen][:, None]
    a, b, c = splats.conics[chosen].T[:, :, None]
    u = 0.5 * (a * d[..., 0] ** 2 + c * d[..., 1] ** 2) + b * d[..., 0] * d[..., 1]
    falloff = torch.exp(-u * (1.0 + splats.sharpness * u))
    alpha = (splats.opacities[chosen][:, None] * falloff).clamp(max=ALPHA_MAX)
    valid = (u >= 0) & (alpha >= ALPHA_MIN)
    remaining = torch.where(valid, 1.0 - alpha, 1.0).cumprod(0)
    outside = (pixels[:, 0] >= splats.width) | (pixels[:, 1] >= splats.height)
    closing = valid & (remaining <= TRANSMITTANCE_MIN)
    open_rounds = torch.where(closing.any(0), closing.int().argmax(0) + 1, len(chosen))
    open_rounds[outside] = 0
    before = torch.arange(len(chosen))[:, None] < open_rounds
    return valid & before & ~closing, open_rounds


def _warps(width: int, height: int) -> Tensor:
    """Return the pixels of each warp of ``width`` x ``height`` pixels, [8, 32]."""
    pixels = torch.arange(TILE * TILE).view(TILE // height, height, TILE // width, width)
    return pixels.permute(0, 2, 1, 3).reshape(8, 32)


def _reached(splats: Splats, chosen: Tensor, corner: Tensor) -> Tensor:
    """Return which warps each splat's bounding box reaches, [n, 8], as ``parts_reached`` in compositing_cuda.h."""
    a, b, c = splats.conics[chosen].T
    determinant = a * c - b * b
    depth = (splats.opacities[chosen] * 255.0).log().clamp(min=0.0)
    reach = 4.0 * depth / (1.0 + (1.0 + 4.0 * splats.sharpness * depth).sqrt()) + 1e-3
    half = 1.0001 * (torch.stack([c, a], 1) * (reach / determinant)[:, None]).sqrt() + 0.01
    mean = splats.means2d[chosen]
    parts = torch.arange(8)
    low = torch.stack([parts % 2 * 8, parts // 2 * 4], 1) + corner + 0.5
    high = low + torch.tensor([7.0, 3.0])
    return ((mean + half)[:, None] >= low).all(2) & ((mean - half)[:, None] <= high).all(2)
