"""Which splats reach which tile, the slow way: every pixel against every splat, in float64."""

from __future__ import annotations

import torch
from torch import Tensor

from scgs_warp.types import Splats

ALPHA_MIN = 1.0 / 255.0


def usable(splats: Splats) -> Tensor:
    """[N] bool: finite, positive definite, opaque enough, not culled by projection."""
    finite = torch.isfinite(splats.opacities) & torch.isfinite(splats.depths)
    finite &= torch.isfinite(splats.means2d).all(1) & torch.isfinite(splats.conics).all(1)
    a, b, c = splats.conics.double().unbind(1)
    definite = (a * c - b * b > 0) & (a > 0) & (c > 0)
    return finite & definite & (splats.opacities >= ALPHA_MIN) & (splats.radii > 0).all(1)


def needed_pairs(splats: Splats, tile_size: int = 16, margin: float = 0.0) -> set[tuple[int, int]]:
    """All (tile, splat) such that u + s u^2 <= ln(255 o) with 2 u = q - margin at one of the tile's pixels."""
    columns = -(-splats.width // tile_size)
    x = torch.arange(splats.width, dtype=torch.float64) + 0.5
    y = torch.arange(splats.height, dtype=torch.float64) + 0.5
    pairs = set()
    for i in torch.nonzero(usable(splats)).flatten().tolist():
        a, b, c = splats.conics[i].double().tolist()
        dx = (x - splats.means2d[i, 0].double())[None, :]
        dy = (y - splats.means2d[i, 1].double())[:, None]
        q = a * dx * dx + 2 * b * dx * dy + c * dy * dy
        u = (q - margin) / 2
        reached = torch.nonzero(
            u + splats.sharpness * u.clamp(min=0) ** 2 <= (255 * splats.opacities[i].double()).log()
        )
        for tile in torch.unique(reached[:, 0] // tile_size * columns + reached[:, 1] // tile_size).tolist():
            pairs.add((tile, i))
    return pairs
