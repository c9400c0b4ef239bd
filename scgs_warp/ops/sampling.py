"""Farthest-point sampling of control points, in space or in the space of trajectories."""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels import sampling as kernels
from ..runtime.launch import launch

CHUNK = {"cpu": 4096, "cuda": 128}
"""Number of points that one grid index processes; it does not affect the result."""


def farthest_points(points: Tensor, count: int, start: int = 0) -> Tensor:
    """Choose ``count`` points, each the farthest from those chosen before it; ties go to the lower index.

    Args:
        points: [N, D] float32. Non-finite points are chosen last.
        count: number of points to choose, 0 .. N.
        start: index of the first point.

    Returns:
        [count] int64, distinct indices in the order of choice, on the device of the points.

    Raises:
        ValueError: ``points`` is not [N, D], or ``count`` or ``start`` is out of range.
    """
    if points.ndim != 2 or points.shape[1] == 0:
        raise ValueError(f"points must be [N, D] with D > 0, got {tuple(points.shape)}")
    total = points.shape[0]
    if not 0 <= count <= total:
        raise ValueError(f"count must be in 0 .. N, got {count} of {total} points")
    chosen = torch.empty(count, dtype=torch.int64, device=points.device)
    if count == 0:
        return chosen
    if not 0 <= start < total:
        raise ValueError(f"start must be in 0 .. {total - 1}, got {start}")
    points = points.detach().contiguous()
    distances = torch.empty(total, device=points.device)
    launch(kernels.start_distances, total, points, distances)
    size = CHUNK.get(points.device.type, 128)
    chunks = -(-total // size)
    before = (
        torch.zeros(chunks, device=points.device),
        torch.full((chunks,), start, dtype=torch.int32).to(points.device),
    )
    after = torch.empty_like(before[0]), torch.empty_like(before[1])
    for step in range(count):
        launch(kernels.farthest_step, chunks, step, size, points, *before, distances, *after, chosen, grain=4)
        before, after = after, before
    return chosen
