"""Brightness that follows a Gaussian's own rotation, and tints, which change its colour; with gradients."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from ..kernels import shading as kernels
from ..kernels.cpu import shading as cpu_kernels
from ..kernels.types import LANES
from ..runtime.launch import launch
from .forms import Form, chosen_form
from .shapes import check_shapes

COLUMNS = 10
"""Number of shading parameters per Gaussian: a 3 x 3 matrix and a coefficient."""


def _run(plain: wp.Kernel, cpu: wp.Kernel, form: Form, *args: Tensor) -> None:
    """Run a kernel's form for the Gaussians of the first argument."""
    count = args[0].shape[0]
    if form == "cpu":
        launch(cpu, -(-count // LANES), *args, grain=32)
    else:
        launch(plain, count, *args)


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh_dc: Tensor, shading: Tensor, quats: Tensor, quats_t: Tensor, form: Form) -> Tensor:
        shaded = torch.empty_like(sh_dc)
        _run(kernels.shade, cpu_kernels.shade, form, sh_dc, shading, quats, quats_t, shaded)
        ctx.save_for_backward(sh_dc, shading, quats, quats_t)
        ctx.form = form
        return shaded

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_shaded: Tensor):  # type: ignore[override]
        sh_dc, shading, quats, quats_t = ctx.saved_tensors
        v_sh_dc, v_shading = torch.empty_like(sh_dc), torch.empty_like(shading)
        inputs = sh_dc, shading, quats, quats_t, v_shaded.contiguous()
        _run(kernels.shade_adjoint, cpu_kernels.shade_adjoint, ctx.form, *inputs, v_sh_dc, v_shading)
        return v_sh_dc, v_shading, None, None, None


def shade(sh_dc: Tensor, shading: Tensor, quats: Tensor, quats_t: Tensor, *, form: Form = "auto") -> Tensor:
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
        form: kernels to run: ``plain`` on any device, ``cpu`` in SIMD; ``auto`` takes the fastest for the device.

    Returns:
        [N, 3] coefficients of degree 0. Gradients reach only ``sh_dc`` and ``shading``, so that training does not turn
        surfaces to match a brightness.

    Raises:
        ValueError: a shape or the form is wrong.
    """
    count = sh_dc.shape[0]
    expected = {
        "sh_dc": (sh_dc, (count, 3)),
        "shading": (shading, (count, COLUMNS)),
        "quats": (quats, (count, 4)),
        "quats_t": (quats_t, (count, 4)),
    }
    check_shapes(expected)
    quats, quats_t = quats.detach().contiguous(), quats_t.detach().contiguous()
    return _Shade.apply(sh_dc.contiguous(), shading.contiguous(), quats, quats_t, chosen_form(form, sh_dc.device))  # type: ignore


class _Tint(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh_dc: Tensor, tints: Tensor, form: Form):
        tinted = torch.empty_like(sh_dc)
        _run(kernels.tint, cpu_kernels.tint, form, sh_dc, tints, tinted)
        ctx.save_for_backward(sh_dc, tints)
        ctx.form = form
        return tinted

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_tinted: Tensor):  # type: ignore[override]
        sh_dc, tints = ctx.saved_tensors
        v_sh_dc, v_tints = torch.empty_like(sh_dc), torch.empty_like(tints)
        inputs = sh_dc, tints, v_tinted.contiguous()
        _run(kernels.tint_adjoint, cpu_kernels.tint_adjoint, ctx.form, *inputs, v_sh_dc, v_tints)
        return v_sh_dc, v_tints, None


def tint(sh_dc: Tensor, tints: Tensor, *, form: Form = "auto") -> Tensor:
    """Multiply base colours by the exponentials of their tints, each within [-3, 1].

    Args:
        sh_dc: [N, 3] spherical harmonics coefficients of degree 0 (colour less one half, over C0).
        tints: [N, 3] changes of the logarithms of the colours.
        form: as in :func:`shade`.

    Returns:
        [N, 3] coefficients of degree 0. Gradients reach both; a tint at or beyond a limit gets none.

    Raises:
        ValueError: a shape or the form is wrong.
    """
    count = sh_dc.shape[0]
    check_shapes({"sh_dc": (sh_dc, (count, 3)), "tints": (tints, (count, 3))})
    return _Tint.apply(sh_dc.contiguous(), tints.contiguous(), chosen_form(form, sh_dc.device))  # type: ignore[return-value]
