"""Float64 twin of ops/arap.py: loops over nodes and edges, torch's SVD."""

from __future__ import annotations

import torch
from torch import Tensor


def local_rotations(rest: Tensor, posed: Tensor, neighbors: Tensor, weights: Tensor) -> Tensor:
    rotations = []
    for i, row in enumerate(neighbors.tolist()):
        S = torch.zeros(3, 3, dtype=torch.float64)
        for j, n in enumerate(row):
            if n >= 0:
                S = S + weights[i, j] * torch.outer(posed[n] - posed[i], rest[n] - rest[i])
        U, _, Vh = torch.linalg.svd(S)
        flip = torch.diag(torch.tensor([1.0, 1.0, float(torch.sign(torch.det(U @ Vh)))], dtype=torch.float64))
        rotations.append(U @ flip @ Vh)
    return torch.stack(rotations)


def arap_energy(rest: Tensor, posed: Tensor, neighbors: Tensor, weights: Tensor) -> Tensor:
    with torch.no_grad():
        rotations = local_rotations(rest, posed, neighbors, weights)
    energies = []
    for i, row in enumerate(neighbors.tolist()):
        energy = rest.new_zeros(())
        for j, n in enumerate(row):
            if n >= 0:
                residual = (posed[n] - posed[i]) - rotations[i] @ (rest[n] - rest[i])
                energy = energy + weights[i, j] * residual @ residual
        energies.append(energy)
    return torch.stack(energies)


def trajectory_graph(trajectories: Tensor, count: int) -> tuple[Tensor, Tensor]:
    tracks = trajectories.double()
    squared = ((tracks[:, :, None] - tracks[:, None]) ** 2).sum(-1).mean(0)
    squared.fill_diagonal_(torch.inf)
    squared, neighbors = torch.sort(squared, dim=1, stable=True)
    squared, neighbors = squared[:, :count], neighbors[:, :count]
    weights = torch.exp(-squared / (2 * squared.sqrt().mean() ** 2))
    return neighbors, weights / weights.sum(1, keepdim=True)
