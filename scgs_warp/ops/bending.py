"""Bending: posed Gaussians follow control points that an edit has moved further. No gradient."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels import bending as kernels
from ..runtime.launch import launch
from .shapes import check_shapes


class NodeBend(NamedTuple):
    """How an edit moves M control points, and their surroundings with them."""

    nodes: Tensor
    """[M, 3] before the edit."""
    shifts: Tensor
    """[M, 3] displacements."""
    turns: Tensor
    """[M, 4] wxyz, unit."""
    stretches: Tensor
    """[M, 3, 3] stretch of the surroundings, seen before the rotation; the identity where there is none."""
    moved: Tensor
    """[M] int32, 1 if the edit moves the control point."""


class Bent(NamedTuple):
    """Gaussians after the edit."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    blends: Tensor
    """[N, 4] wxyz, unit: the rotation of each by the edit."""


def bend(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    by: NodeBend,
    indices: Tensor,
    weights: Tensor,
    *,
    dual: bool = False,
    widest: float = 1.0,
) -> Bent:
    """Move Gaussians with their control points, and widen them where their surroundings stretch.

    Args:
        means: [N, 3] before the edit.
        quats: [N, 4] wxyz, need not be unit.
        scales: [N, 3]
        by: bend of the M control points.
        indices: [N, K] int32 in [0, M), not checked against M.
        weights: [N, K] not negative, rows sum to 1; control points of weight 0 have no effect.
        dual: whether motions blend as dual quaternions instead of linearly.
        widest: largest factor by which a Gaussian widens; 1: none does.

    Returns:
        Gaussians; those of which no control point moves have the same bits as before. No gradient.

    Raises:
        ValueError: a shape is wrong.
    """
    count, total = by.nodes.shape[0], means.shape[0]
    expected = {
        "means": (means, (total, 3)), "quats": (quats, (total, 4)), "scales": (scales, (total, 3)),
        "nodes": (by.nodes, (count, 3)), "shifts": (by.shifts, (count, 3)), "turns": (by.turns, (count, 4)),
        "stretches": (by.stretches, (count, 3, 3)), "moved": (by.moved, (count,)),
        "weights": (weights, (total, indices.shape[-1])), "indices": (indices, (total, indices.shape[-1])),
    }  # fmt: skip
    check_shapes(expected)
    inputs = [value.detach().contiguous() for value in (means, quats, scales, *by)]
    found = Bent(*(torch.empty_like(value) for value in (*inputs[:3], inputs[1])))
    binding = indices.contiguous(), weights.contiguous()
    launch(kernels.bend, total, *inputs, int(dual), float(widest), *binding, *found, grain=256)
    return found
