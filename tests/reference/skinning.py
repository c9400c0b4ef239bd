"""Float64 twin of ops/skinning.py: rotation matrices, gathers, no shortcuts."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from scgs_warp.types import Pose


def matrix(quats: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of unit wxyz quaternions."""
    w, x, y, z = quats.unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, -1).reshape(*quats.shape[:-1], 3, 3)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton products of wxyz quaternions."""
    scalar = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdim=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + torch.linalg.cross(a[..., 1:], b[..., 1:])
    return torch.cat([scalar, vector], -1)


def skin(
    means: Tensor, quats: Tensor, nodes: Tensor, pose: Pose, indices: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor, Tensor | None]:
    picked = indices.long()
    rotations = normalize(pose.rotations, dim=-1)
    arms = means[:, None] - nodes[picked]
    moved = torch.einsum("nkij,nkj->nki", matrix(rotations[picked]), arms) + nodes[picked] + pose.translations[picked]
    shapes = rotations if pose.shape_rotations is None else normalize(pose.shape_rotations, dim=-1)
    shapes = shapes[picked]
    signs = torch.where((shapes * shapes[:, :1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    blend = normalize((weights[..., None] * signs * shapes).sum(1), dim=-1)
    extras = pose.log_scales if pose.tints is None else pose.tints
    extras = None if extras is None else (weights[..., None] * extras[picked]).sum(1)
    return (weights[..., None] * moved).sum(1), multiply(blend, normalize(quats, dim=-1)), extras
