"""Gradients of control points (nodes) on CUDA: sums over the sorted list of all pairs of Gaussian and node."""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels.cuda import node_sums as kernels
from ..kernels.skinning import SUMS
from ..runtime.launch import launch


def skin_node_sums(order: Tensor, begin: Tensor, pairs: tuple, has_extras: int) -> Tensor:
    """Return the sums [M, SUMS] for ``skin_finish``, with 3 more columns if there are extras.

    ``pairs`` are the arguments of ``skin_segments`` from ``means_in`` on; the second of them is ``nodes``."""
    rows = _rows(order, pairs[1], SUMS + 3 * has_extras)
    launch(kernels.skin_segments, _segments(order), order, *pairs, rows, grain=8)
    return _sum(begin, rows)


def rbf_node_sums(
    order: Tensor, begin: Tensor, points: Tensor, nodes: Tensor, indices: Tensor, v_logits: Tensor
) -> Tensor:
    """Return the sums [M, 2 + D] for ``rbf_finish``."""
    parts = -(-nodes.shape[1] // kernels.LANES)
    rows = _rows(order, nodes, 2 + nodes.shape[1])
    launch(
        kernels.rbf_segments, parts * _segments(order), parts, order, points, nodes, indices, v_logits, rows, grain=8
    )
    return _sum(begin, rows)


def _segments(order: Tensor) -> int:
    return -(-len(order) // kernels.SEGMENT)


def _rows(order: Tensor, nodes: Tensor, width: int) -> Tensor:
    return torch.empty(_segments(order) + len(nodes), width, device=order.device)


def _sum(begin: Tensor, rows: Tensor) -> Tensor:
    sums = torch.empty(len(begin) - 1, rows.shape[1], device=rows.device)
    launch(kernels.sum_segments, sums.numel(), begin, rows, sums)
    return sums
