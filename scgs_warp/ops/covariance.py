"""3D covariance of Gaussians, with gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..kernels import covariance as kernels
from ..runtime.launch import launch


class _Covariance(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, quats: Tensor, scales: Tensor) -> Tensor:
        covariances = torch.empty(quats.shape[0], 3, 3, device=quats.device)
        launch(kernels.covariance, quats.shape[0], quats, scales, covariances)
        ctx.save_for_backward(quats, scales)
        return covariances

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_covariances: Tensor):  # type: ignore[override]
        quats, scales = ctx.saved_tensors
        v_quats, v_scales = torch.empty_like(quats), torch.empty_like(scales)
        v_covariances = v_covariances.contiguous()
        launch(kernels.covariance_adjoint, quats.shape[0], quats, scales, v_covariances, v_quats, v_scales)
        return v_quats, v_scales


def covariance(quats: Tensor, scales: Tensor) -> Tensor:
    """Covariances ``R S S^T R^T`` of Gaussians (3D-GS, equation 6).

    Args:
        quats: [N, 4] float32, wxyz, any norm (a zero quaternion counts as the identity and gets no gradient).
        scales: [N, 3] float32, standard deviations along the Gaussian's own axes, world units.

    Returns:
        [N, 3, 3] symmetric, world units squared; zero where it would not be finite. Gradients reach both inputs, but
        where they or the inputs are not finite.

    Raises:
        ValueError: a shape is wrong.
    """
    if quats.ndim != 2 or quats.shape[1] != 4:
        raise ValueError(f"quats must be [N, 4], got {tuple(quats.shape)}")
    if tuple(scales.shape) != (quats.shape[0], 3):
        raise ValueError(f"scales must be [{quats.shape[0]}, 3], got {tuple(scales.shape)}")
    return _Covariance.apply(quats.contiguous(), scales.contiguous())
