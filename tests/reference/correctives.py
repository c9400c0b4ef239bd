"""Pose-dependent correctives in plain torch, differentiable."""

from __future__ import annotations

import torch
from torch import Tensor

from reference.quaternion import multiply, normalise, to_matrix


def correct(
    means: Tensor, correctives: Tensor, quats: Tensor, quats_t: Tensor, quats_own: Tensor | None = None
) -> Tensor:
    """[N, 3]: means + 0.1 R C vec(R_own - I)."""
    conjugate = normalise(quats) * torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=quats.dtype, device=quats.device)
    rotation, own = (
        to_matrix(multiply(normalise(posed), conjugate)).detach()
        for posed in (quats_t, quats_t if quats_own is None else quats_own)
    )
    turn = own - torch.eye(3, dtype=quats.dtype, device=quats.device)
    shift = torch.einsum("nak,nk->na", correctives.reshape(-1, 3, 9), turn.reshape(-1, 9))
    return means + 0.1 * torch.einsum("nij,nj->ni", rotation, shift)
