"""3D covariances in plain torch, differentiable."""

from __future__ import annotations

import torch
from torch import Tensor

from reference.quaternion import normalise, to_matrix


def covariance(quats: Tensor, scales: Tensor) -> Tensor:
    """[N, 3, 3] = R diag(scales^2) R^T."""
    rotation = to_matrix(normalise(quats))
    return rotation @ torch.diag_embed(scales**2) @ rotation.transpose(-1, -2)
