"""Rows of numbers as indices into a palette of rows: k-means in two levels, fast for large palettes."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

ROUNDS = 10
"""Rounds of k-means on each level."""
SAMPLE = 256
"""Rows per coarse cluster from which the coarse clusters are found."""
AT_ONCE = 1 << 24
"""Largest number of distances that are computed at once."""


def make_palette(rows: np.ndarray, size: int, weights: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Choose at most ``size`` rows for finite rows [N, D], so that the squared distances are small.

    Rows of at most ``size`` kinds are kept exactly. The same rows give the same palette.

    Args:
        weights: [N] > 0, how much each row matters; None: all the same.

    Returns:
        The palette [K, D] float32, and the index [N] int64 of each row's entry.
    """
    table = np.ascontiguousarray(rows, np.float32) + np.float32(0.0)  # -0 becomes 0
    whole = table.view(np.dtype((np.void, table.shape[1] * table.itemsize))).ravel()
    kinds, first, index = np.unique(whole, return_index=True, return_inverse=True)
    if len(kinds) <= size:
        return table[first], index.reshape(-1)
    random = torch.Generator().manual_seed(0)
    points = torch.from_numpy(table)
    weight = torch.ones(len(points)) if weights is None else torch.from_numpy(weights.astype(np.float32))
    coarse_count = max(1, round(size**0.5))
    sample = torch.randperm(len(points), generator=random)[: SAMPLE * coarse_count]
    coarse = _k_means(points[sample], weight[sample], coarse_count, random)
    cell, error = _nearest(points, coarse)
    palette, labels = [], torch.empty(len(points), dtype=torch.int64)
    sizes = _shares(cell, weight * error, coarse_count, size)
    order = torch.argsort(cell, stable=True)
    start = 0
    for members, count in zip(order.split(torch.bincount(cell, minlength=coarse_count).tolist()), sizes):
        if len(members):
            fine = _k_means(points[members], weight[members], count, random)
            labels[members] = start + _nearest(points[members], fine)[0]
            palette.append(fine)
            start += len(fine)
    return torch.cat(palette).numpy(), labels.numpy()


def _shares(cell: Tensor, error: Tensor, cells: int, size: int) -> list[int]:
    """Return how many of ``size`` entries each cell gets: at least one, at most one for each of its members, and by its
    number of members and their weighted squared distances from its centre, ``error`` [N]."""
    counts = torch.bincount(cell, minlength=cells).double()
    weight = torch.zeros(cells, dtype=torch.float64).index_add_(0, cell, error.double())
    weight = (counts * weight.sqrt()).sqrt() + 1e-30
    shares = torch.ones(cells, dtype=torch.float64)
    for _ in range(30):  # What a full cell cannot take goes to the others.
        room = (counts - shares).clamp_min(0.0) > 0
        left = size - shares.sum()
        if left < 1 or not room.any():
            break
        more = torch.where(room, weight, 0.0)
        shares = torch.minimum(shares + left * more / more.sum(), counts.clamp_min(1.0))
    return shares.floor().long().tolist()


def _k_means(points: Tensor, weight: Tensor, count: int, random: torch.Generator) -> Tensor:
    """Return at most ``count`` centres of points [N, D] with weights [N]."""
    if count >= len(points):
        return points
    first = torch.rand(len(points), generator=random).log() / weight  # the largest are a draw by weight
    centres = points[first.topk(count).indices].clone()
    weight = weight.double()
    for _ in range(ROUNDS):
        nearest, _ = _nearest(points, centres)
        totals = torch.zeros(count, dtype=torch.float64).index_add_(0, nearest, weight)
        sums = torch.zeros(centres.shape, dtype=torch.float64)
        sums.index_add_(0, nearest, weight[:, None] * points.double())
        used = totals > 0  # A centre without points stays where it is.
        centres[used] = (sums[used] / totals[used, None]).float()
    return centres


def _nearest(points: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
    """Return the index of the nearest centre [N] int64, and the squared distance to it [N]."""
    found = []
    squares = (centres * centres).sum(dim=1)
    for part in points.split(max(1, AT_ONCE // len(centres))):
        least, index = torch.addmm(squares, part, centres.T, alpha=-2.0).min(dim=1)
        found.append((index, (least + (part * part).sum(dim=1)).clamp_min(0.0)))
    index, error = zip(*found)
    return torch.cat(index), torch.cat(error)
