"""Float64 twin of ops/neighbors.py: every distance, one stable sort."""

from __future__ import annotations

import torch
from torch import Tensor


def nearest(points: Tensor, nodes: Tensor, k: int) -> tuple[Tensor, Tensor]:
    distances = ((points.double()[:, None] - nodes.double()[None]) ** 2).sum(-1)
    distances, indices = torch.sort(distances, dim=1, stable=True)
    return indices[:, :k], distances[:, :k]


def rbf_weights(
    points: Tensor, nodes: Tensor, radii: Tensor, indices: Tensor, strengths: Tensor | None = None
) -> Tensor:
    picked = indices.long()
    squared = ((points[:, None] - nodes[picked]) ** 2).sum(-1)
    logits = -squared / (2 * radii[picked] ** 2)
    if strengths is not None:
        logits = logits + strengths[picked].log()
    return torch.softmax(logits, dim=1)
