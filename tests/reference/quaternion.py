"""Quaternions (wxyz) in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor


def normalise(q: Tensor) -> Tensor:
    """[..., 4] unit; the identity for zero."""
    norm = q.norm(dim=-1, keepdim=True)
    identity = torch.zeros_like(q)
    identity[..., 0] = 1.0
    return torch.where(norm > 0, q / torch.where(norm > 0, norm, 1.0), identity)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product [..., 4], from the scalar and vector parts."""
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdim=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + torch.linalg.cross(a[..., 1:], b[..., 1:])
    return torch.cat([scalar, vector], dim=-1)


def rotate(q: Tensor, x: Tensor) -> Tensor:
    """q x q* for a unit quaternion, [..., 3]."""
    conjugate = q * torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=q.dtype, device=q.device)
    pure = torch.cat([torch.zeros_like(x[..., :1]), x], dim=-1)
    return multiply(multiply(q, pure), conjugate)[..., 1:]


def to_matrix(q: Tensor) -> Tensor:
    """[..., 3, 3]; its columns are the rotated axes."""
    axes = torch.eye(3, dtype=q.dtype, device=q.device)
    return torch.stack([rotate(q, axes[k].expand(*q.shape[:-1], 3)) for k in range(3)], dim=-1)
