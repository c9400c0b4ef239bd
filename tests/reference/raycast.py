"""Every ray against every triangle, float64 (Moeller and Trumbore 1997)."""

from __future__ import annotations

import torch
from torch import Tensor


def first_hit(vertices: Tensor, faces: Tensor, origin: Tensor, directions: Tensor) -> Tensor:
    """[R] smallest t > 0 at which ``origin + t * direction`` meets a triangle, infinity where none.

    Args:
        vertices: [P, 3]
        faces: [F, 3]
        origin: [3]
        directions: [R, 3], any length.
    """
    a, b, c = vertices[faces].unbind(1)
    first, second = b - a, c - a
    nearest = []
    for direction in directions:
        p = torch.linalg.cross(direction.expand_as(second), second)
        determinant = (first * p).sum(1)
        safe = torch.where(determinant.abs() > 1e-14, determinant, torch.full_like(determinant, float("nan")))
        offset = origin - a
        u = (offset * p).sum(1) / safe
        q = torch.linalg.cross(offset, first)
        v = (q * direction).sum(1) / safe
        t = (second * q).sum(1) / safe
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        nearest.append(torch.where(inside, t, torch.full_like(t, float("inf"))).min())
    return torch.stack(nearest)
