"""As-rigid-as-possible energy of the control points (SC-GS, Eq. 8 to 10), for training and for editing."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..kernels import arap as kernels
from ..runtime.launch import launch
from .neighbors import NodeLists, nearest, node_lists


def _validate(rest: Tensor, posed: Tensor, neighbors: Tensor, weights: Tensor) -> None:
    if rest.ndim != 2 or rest.shape[1] != 3:
        raise ValueError(f"rest must be [M, 3], got {tuple(rest.shape)}")
    if posed.shape != rest.shape:
        raise ValueError(f"posed must be {tuple(rest.shape)} as rest, got {tuple(posed.shape)}")
    if neighbors.ndim != 2 or neighbors.shape[0] != rest.shape[0] or neighbors.dtype != torch.int32:
        raise ValueError(
            f"neighbors must be int32 [{rest.shape[0]}, J], got {neighbors.dtype} {tuple(neighbors.shape)}"
        )
    if weights.shape != neighbors.shape:
        raise ValueError(f"weights must be {tuple(neighbors.shape)} as neighbors, got {tuple(weights.shape)}")


def _rotations(rest: Tensor, posed: Tensor, neighbors: Tensor, weights: Tensor) -> Tensor:
    rotations = torch.empty(rest.shape[0], 3, 3, device=rest.device)
    launch(kernels.local_rotations, rest.shape[0], rest, posed, neighbors, weights, rotations, grain=64)
    return rotations


def local_rotations(rest: Tensor, posed: Tensor, neighbors: Tensor, weights: Tensor) -> Tensor:
    """Return the best rotation of every node's edges: argmin sum_j w_ij |e'_ij - R e_ij|^2 (SC-GS, Eq. 8).

    Args:
        rest: [M, 3] positions at rest.
        posed: [M, 3] positions after the deformation.
        neighbors: [M, J] int32, -1 for a missing neighbour.
        weights: [M, J] >= 0.

    Returns:
        [M, 3, 3] rotations, always with determinant +1; the identity for a node without edges. No gradient.

    Raises:
        ValueError: shapes do not fit.
    """
    _validate(rest, posed, neighbors, weights)
    values = (value.detach().contiguous() for value in (rest, posed, neighbors, weights))
    return _rotations(*values)


def reverse_edges(neighbors: Tensor) -> NodeLists:
    """Return the incoming edges of each node, which many calls of ``arap_energy`` can share."""
    return node_lists(neighbors, neighbors.shape[0])


class _ArapEnergy(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rest, posed, neighbors, weights, reverse):
        rotations = _rotations(rest, posed, neighbors, weights)
        energies = torch.empty(rest.shape[0], device=rest.device)
        launch(kernels.arap_energy, rest.shape[0], rest, posed, neighbors, weights, rotations, energies, grain=128)
        ctx.save_for_backward(rest, posed, neighbors, weights, rotations)
        ctx.reverse = reverse
        return energies

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients):  # type: ignore[override]
        rest, posed, neighbors, weights, rotations = ctx.saved_tensors
        reverse = ctx.reverse or reverse_edges(neighbors)
        v_rest, v_posed = torch.empty_like(rest), torch.empty_like(posed)
        launch(
            kernels.arap_energy_adjoint,
            rest.shape[0],
            *(rest, posed, neighbors, weights, rotations, *reverse, gradients[0].contiguous()),
            *(v_rest, v_posed),
            grain=64,
        )
        return v_rest, v_posed, None, None, None


def arap_energy(
    rest: Tensor, posed: Tensor, neighbors: Tensor, weights: Tensor, *, reverse: NodeLists | None = None
) -> Tensor:
    """Return the energy of every node, sum_j w_ij |e'_ij - R_i e_ij|^2 with the best rotation R_i (SC-GS, Eq. 9).

    Args:
        rest: [M, 3] positions at rest.
        posed: [M, 3] positions after the deformation.
        neighbors: [M, J] int32 in [0, M), -1 for a missing neighbour.
        weights: [M, J] >= 0.
        reverse: ``reverse_edges(neighbors)``, if computed before.

    Returns:
        [M] energies, in squared units of the positions; non-finite for a node with an edge to a non-finite position.
        Gradients flow to rest and posed, except along such edges; the rotations are held constant, since their own
        gradient vanishes at the minimum.

    Raises:
        ValueError: shapes do not fit.
    """
    _validate(rest, posed, neighbors, weights)
    return _ArapEnergy.apply(  # type: ignore[return-value]
        rest.contiguous(), posed.contiguous(), neighbors.contiguous(), weights.detach().contiguous(), reverse
    )


def trajectory_graph(trajectories: Tensor, count: int = 8) -> tuple[Tensor, Tensor]:
    """Return the control points' nearest neighbours by distance over time, and their weights (SC-GS, Eq. 10).

    The squared distance of two nodes is averaged over the sampled times. Weights are ``exp(-d^2 / (2 h^2))`` with h the
    mean neighbour distance, normalised for every node.

    Args:
        trajectories: [T, M, 3] positions of the M nodes at T times.
        count: neighbours per node, 1 .. 15.

    Returns:
        Neighbours [M, count] int32, nearest first, padded with -1, and weights [M, count], padded with 0. No gradient.

    Raises:
        ValueError: shapes do not fit or ``count`` is out of range.
    """
    if trajectories.ndim != 3 or trajectories.shape[2] != 3 or trajectories.shape[0] == 0:
        raise ValueError(f"trajectories must be [T, M, 3] with T > 0, got {tuple(trajectories.shape)}")
    if not 1 <= count <= 15:
        raise ValueError(f"count must be in 1 .. 15, got {count}")
    times, nodes, _ = trajectories.shape
    device = trajectories.device
    neighbors = torch.full((nodes, count), -1, dtype=torch.int32, device=device)
    weights = torch.zeros(nodes, count, device=device)
    available = min(count, nodes - 1)
    if available <= 0:
        return neighbors, weights
    tracks = trajectories.detach().permute(1, 0, 2).reshape(nodes, 3 * times) / times**0.5
    indices, distances = nearest(tracks, tracks, available + 1)
    # Every node is removed from its own list. Among duplicates it need not come first; if it is missing, the last entry
    # is removed instead. A non-finite node may appear twice: its list then ends with placeholders.
    own = indices == torch.arange(nodes, device=device, dtype=torch.int32)[:, None]
    own &= own.cumsum(dim=1) == 1
    own[:, -1] |= ~own.any(dim=1)
    indices, distances = indices[~own].reshape(nodes, -1), distances[~own].reshape(nodes, -1).double()
    finite = distances.isfinite()
    lengths = distances.sqrt().where(finite, 0.0).sum(dim=1)
    total = torch.ones_like(lengths) @ lengths
    bandwidth = total / (torch.ones_like(lengths) @ finite.sum(dim=1).double()).clamp_min(1)
    logits = (-distances / (2 * bandwidth**2).clamp_min(1e-60)).where(finite, -torch.inf)
    raw = torch.softmax(logits, dim=1).where(finite, 0.0)
    indices = indices.where(finite, -1)
    neighbors[:, :available], weights[:, :available] = indices, raw.float()
    return neighbors, weights
