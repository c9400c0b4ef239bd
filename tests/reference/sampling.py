"""Float64 twin of ops/sampling.py."""

from __future__ import annotations

import torch
from torch import Tensor


def farthest_points(points: Tensor, count: int, start: int = 0) -> Tensor:
    points = points.double()
    distances = torch.full((len(points),), torch.inf, dtype=torch.float64)
    chosen: list[int] = []
    for _ in range(count):
        chosen.append(start)
        distances = torch.minimum(distances, ((points - points[start]) ** 2).sum(1))
        distances[chosen] = -1.0
        start = int(distances.argmax())
    return torch.tensor(chosen)
