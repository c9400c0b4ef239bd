"""Brightness that follows a Gaussian's own rotation, and tints, which change its colour; with gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..kernels import shading as kernels
from ..runtime.launch import launch

COLUMNS = 10
"""Number of shading parameters per Gaussian: a 3 x 3 matrix and a coefficient."""


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh_dc: Tensor, shading: Tensor, quats: Tensor, quats_t: Tensor) -> Tensor:
        shaded = torch.empty_like(sh_dc)
        launch(kernels.shade, sh_dc.shape[0], sh_dc, shading, quats, quats_t, shaded)
        ctx.save_for_backward(sh_dc, shading, quats, quats_t)
        return shaded

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_shaded: Tensor):  # type: ignore[override]
        sh_dc, shading, quats, quats_t = ctx.saved_tensors
        v_sh_dc, v_shading = torch.empty_like(sh_dc), torch.empty_like(shading)
        inputs = sh_dc, shading, quats, quats_t, v_shaded.contiguous()
        launch(kernels.shade_adjoint, sh_dc.shape[0], *inputs, v_sh_dc, v_shading)
        return v_sh_dc, v_shading, None, None


def shade(sh_dc: Tensor, shading: Tensor, quats: Tensor, quats_t: Tensor) -> Tensor:
    """Multiply base colours by ``1 + x + 5 b x^2`` within [0, 4], where ``x = <G, R - I>`` and R turns ``quats`` to
    ``quats_t``.

    The light that a diffuse surface reflects is, to first order, linear in its normal: G holds the light and the
    normal, and b describes lamps, whose light is cut off at grazing angles. Both are learnt for each Gaussian. At rest
    the factor is 1.

    Args:
        sh_dc: [N, 3] spherical harmonics coefficients of degree 0 (colour less one half, over C0).
        shading: [N, 10] the matrices G, row by row, and b.
        quats: [N, 4] wxyz at rest, any norm.
        quats_t: [N, 4] wxyz at the rendered instant, any norm.

    Returns:
        [N, 3] coefficients of degree 0. Gradients reach only ``sh_dc`` and ``shading``, so that training does not turn
        surfaces to match a brightness.

    Raises:
        ValueError: a shape is wrong.
    """
    count = sh_dc.shape[0]
    expected = {"sh_dc": (sh_dc, 3), "shading": (shading, COLUMNS), "quats": (quats, 4), "quats_t": (quats_t, 4)}
    for name, (value, width) in expected.items():
        if tuple(value.shape) != (count, width):
            raise ValueError(f"{name} must be [{count}, {width}], got {tuple(value.shape)}")
    quats, quats_t = quats.detach().contiguous(), quats_t.detach().contiguous()
    return _Shade.apply(sh_dc.contiguous(), shading.contiguous(), quats, quats_t)


class _Tint(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh_dc: Tensor, tints: Tensor):
        tinted = torch.empty_like(sh_dc)
        launch(kernels.tint, sh_dc.shape[0], sh_dc, tints, tinted)
        ctx.save_for_backward(sh_dc, tints)
        return tinted

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_tinted: Tensor):  # type: ignore[override]
        sh_dc, tints = ctx.saved_tensors
        v_sh_dc, v_tints = torch.empty_like(sh_dc), torch.empty_like(tints)
        launch(kernels.tint_adjoint, sh_dc.shape[0], sh_dc, tints, v_tinted.contiguous(), v_sh_dc, v_tints)
        return v_sh_dc, v_tints


def tint(sh_dc: Tensor, tints: Tensor) -> Tensor:
    """Multiply base colours by the exponentials of their tints, each within [-3, 1].

    Args:
        sh_dc: [N, 3] spherical harmonics coefficients of degree 0 (colour less one half, over C0).
        tints: [N, 3] changes of the logarithms of the colours.

    Returns:
        [N, 3] coefficients of degree 0. Gradients reach both; a tint at or beyond a limit gets none.

    Raises:
        ValueError: a shape is wrong.
    """
    for name, value in {"sh_dc": sh_dc, "tints": tints}.items():
        if tuple(value.shape) != (sh_dc.shape[0], 3):
            raise ValueError(f"{name} must be [{sh_dc.shape[0]}, 3], got {tuple(value.shape)}")
    return _Tint.apply(sh_dc.contiguous(), tints.contiguous())
