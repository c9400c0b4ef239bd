"""Twin of ops.planes in float64: every Gaussian's texels written out; their smoothness as differences."""

from __future__ import annotations

import torch
from torch import Tensor

PAIRS = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))


def coordinate(value: Tensor, extent: int) -> tuple[Tensor, Tensor]:
    """Texel before a coordinate in [-1, 1] and the way to the next, for a plane of ``extent`` texels."""
    x = (value + 1.0) / 2.0 * (extent - 1)
    x = torch.where((x > 0.0) & (x < extent - 1), x, x.detach().clamp(0.0, extent - 1).nan_to_num(0.0))
    cell = x.detach().floor().clamp(max=extent - 2)
    return cell.long(), (x - cell)[:, None]


def features(positions: Tensor, time: float, planes: list[Tensor]) -> Tensor:
    where = torch.cat([positions, torch.full_like(positions[:, :1], 2.0 * time - 1.0)], dim=1)
    levels = []
    for level in range(0, len(planes), 6):
        product = torch.ones(len(positions), planes[0].shape[2], dtype=positions.dtype)
        for (first, second), plane in zip(PAIRS, planes[level : level + 6]):
            column, a = coordinate(where[:, first], plane.shape[1])
            row, b = coordinate(where[:, second], plane.shape[0])
            upper = plane[row, column] * (1.0 - a) + plane[row, column + 1] * a
            lower = plane[row + 1, column] * (1.0 - a) + plane[row + 1, column + 1] * a
            product = product * (upper * (1.0 - b) + lower * b)
        levels.append(product)
    return torch.cat(levels, dim=1)


def variation(planes: list[Tensor], space: float = 1.0, time: float = 1.0, rest: float = 0.0) -> Tensor:
    total = torch.zeros((), dtype=planes[0].dtype)
    for place, plane in enumerate(planes):
        total = total + space * ((plane[:, 1:] - plane[:, :-1]) ** 2).mean()
        down = plane[1:] - plane[:-1]
        if place % 6 < 3:
            total = total + space * (down**2).mean()
            continue
        bend = down[1:] - down[:-1]
        if bend.numel():
            total = total + time * (bend**2).mean()
        total = total + rest * (1.0 - plane).abs().mean()
    return total
