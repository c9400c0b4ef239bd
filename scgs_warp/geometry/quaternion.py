"""Quaternions in torch for the few places that are not worth a kernel. wxyz."""

from __future__ import annotations

import torch
from torch import Tensor


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Turn ``vectors`` [N, 3] by ``quats`` [N, 4], which need not be unit."""
    unit = torch.nn.functional.normalize(quats, dim=-1)
    w, axis = unit[..., :1], unit[..., 1:]
    twice = 2.0 * torch.linalg.cross(axis, vectors)
    return vectors + w * twice + torch.linalg.cross(axis, twice)
