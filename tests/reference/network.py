"""Twin of ops.network: the layers one by one."""

from __future__ import annotations

import torch
from torch import Tensor


def network(where: Tensor, when: Tensor, weights: list[Tensor], biases: list[Tensor]) -> Tensor:
    rows = [torch.cat([position, time]) for time in when for position in where]
    outputs = []
    for row in rows:
        value = torch.zeros(0, dtype=row.dtype)
        for layer, (weight, bias) in enumerate(zip(weights, biases)):
            if weight.shape[1] != len(value):
                value = torch.cat([row, value])
            value = weight @ value + bias
            if layer + 1 < len(weights):
                value = torch.where(value < 0, torch.zeros_like(value), value)
        outputs.append(value)
    return torch.stack(outputs) if outputs else torch.zeros(0, weights[-1].shape[0], dtype=where.dtype)


def bfloat16(values: Tensor) -> Tensor:
    """Round to bfloat16, in the values' own precision."""
    return values.float().bfloat16().to(values.dtype)


def gradients_in_bfloat16(
    where: Tensor, when: Tensor, weights: list[Tensor], biases: list[Tensor], v_out: Tensor
) -> list[Tensor]:
    """Return the gradients of weights and biases of rounded factors: sums are exact, and rounded where they become
    factors."""
    rows = torch.stack([torch.cat([position, time]) for time in when for position in where])
    read, value = [], rows[:, :0]
    for layer, (weight, bias) in enumerate(zip(weights, biases)):
        read.append(value if weight.shape[1] == value.shape[1] else torch.cat([rows, value], 1))
        value = read[-1] @ weight.T + bias
        if layer + 1 < len(weights):
            value = value.clamp_min(0.0)
    v, of_weights, of_biases = bfloat16(v_out), [], []
    for layer in reversed(range(len(weights))):
        of_weights.insert(0, v.T @ bfloat16(read[layer]))
        of_biases.insert(0, v.sum(0))
        if layer:
            own = weights[layer - 1].shape[0]
            v = bfloat16((v @ bfloat16(weights[layer]))[:, -own:] * (read[layer][:, -own:] > 0))
    return of_weights + of_biases
