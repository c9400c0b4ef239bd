"""Alpha compositing in float64 torch: per tile, all splats against all pixels, differentiable by autograd."""

from __future__ import annotations

import torch
from torch import Tensor

from scgs_warp.types import Splats, Tiles

ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN = 1.0 / 255.0, 0.999, 1e-4


def composite(
    splats: Splats,
    channels: Tensor,
    tiles: Tiles,
    background: Tensor | None = None,
    *,
    crop: tuple[int, int, int, int] | None = None,
    saved: dict[tuple[int, int], tuple[Tensor, Tensor]] | None = None,
) -> tuple[Tensor, Tensor]:
    """What ``ops.compositing.composite`` computes, from its definition.

    Args:
        splats, channels, tiles, background: as there; any dtype, computed in float64 on the CPU.
        crop: (x0, y0, x1, y1) in pixels; only tiles that meet it are computed. None: the whole image.
        saved: if given, filled with, for each (column, row) of tile, the leaf offsets [K, P, 2] that were added to the
            means and the splats' indices [K]; their gradient is the per-pixel gradient of means2d.

    Returns:
        image [C, h, w] and alpha [h, w] of the crop, float64.
    """
    means, conics, opacities, channels = (
        t.cpu().double() for t in (splats.means2d, splats.conics, splats.opacities, channels)
    )
    background = channels.new_zeros(channels.shape[1]) if background is None else background.cpu().double()
    x0, y0, x1, y1 = crop or (0, 0, tiles.width, tiles.height)
    ranges, order, size = tiles.ranges.cpu(), tiles.splats.cpu().long(), tiles.tile_size
    rows = []
    for row in range(y0 // size, -(-y1 // size)):
        cells = []
        for column in range(x0 // size, -(-x1 // size)):
            xs = torch.arange(max(x0, column * size), min(x1, (column + 1) * size), dtype=torch.float64) + 0.5
            ys = torch.arange(max(y0, row * size), min(y1, (row + 1) * size), dtype=torch.float64) + 0.5
            begin, end = ranges[row * tiles.columns + column].tolist()
            index = order[begin:end]
            index = index[torch.isfinite(channels[index]).all(1)]
            pixels = torch.stack(torch.meshgrid(xs, ys, indexing="xy"), -1).reshape(-1, 2)
            mean = means[index][:, None]
            if saved is not None:
                offsets = torch.zeros(len(index), len(pixels), 2, dtype=torch.float64, requires_grad=True)
                saved[column, row] = (offsets, index)
                mean = mean + offsets
            rows_of = conics[index], opacities[index], channels[index]
            cell = _composite_pixels(pixels, mean, *rows_of, background, splats.sharpness)
            cells.append(cell.reshape(len(cell), len(ys), len(xs)))
        rows.append(torch.cat(cells, 2))
    image = torch.cat(rows, 1)
    return image[:-1], image[-1]


def _composite_pixels(
    pixels: Tensor,
    means: Tensor,
    conics: Tensor,
    opacities: Tensor,
    channels: Tensor,
    background: Tensor,
    sharpness: float,
) -> Tensor:
    """[C + 1, P]: channels and alpha of P pixels, from K splats in order."""
    d = pixels[None] - means
    a, b, c = conics[:, None].unbind(-1)
    q = a * d[..., 0] ** 2 + 2 * b * d[..., 0] * d[..., 1] + c * d[..., 1] ** 2
    alpha = torch.clamp(opacities[:, None] * torch.exp(-q / 2 - sharpness * (q / 2) ** 2), max=ALPHA_MAX)
    alpha = torch.where((q < 0) | (alpha < ALPHA_MIN), torch.zeros_like(alpha), alpha)
    after = torch.cumprod(1 - alpha, 0)
    # The transmittance only falls: once a splat would leave too little, so would every later one.
    alpha = torch.where(after <= TRANSMITTANCE_MIN, torch.zeros_like(alpha), alpha)
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]]) if len(after) else after
    remaining = after[-1] if len(after) else pixels.new_ones(len(pixels))
    image = channels.T @ (alpha * before) + background[:, None] * remaining
    return torch.cat([image, (1 - remaining)[None]])
