"""Colours that follow the turn of their surface, in plain torch, differentiable."""

from __future__ import annotations

import torch
from torch import Tensor

from reference.quaternion import multiply, normalise, to_matrix

C0 = 0.28209479177387814


def tint(sh_dc: Tensor, tints: Tensor) -> Tensor:
    """[N, 3]: colours times exp(clamp(tint, -3, 1)), as coefficients again."""
    return ((0.5 + C0 * sh_dc) * tints.clamp(-3.0, 1.0).exp() - 0.5) / C0


def shade(sh_dc: Tensor, shading: Tensor, quats: Tensor, quats_t: Tensor) -> Tensor:
    """[N, 3]: colour at rest times clamp(1 + x + 5 b x^2, 0, 4) with x = <G, R - I>, as coefficients again."""
    conjugate = normalise(quats) * torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=quats.dtype, device=quats.device)
    turn = to_matrix(multiply(normalise(quats_t), conjugate)) - torch.eye(3, dtype=quats.dtype, device=quats.device)
    x = (shading[:, :9].reshape(-1, 3, 3) * turn).sum((1, 2))
    gain = 1.0 + x + 5.0 * shading[:, 9] * x**2
    color = (0.5 + C0 * sh_dc) * gain.clamp(0.0, 4.0)[:, None]
    return (color - 0.5) / C0
