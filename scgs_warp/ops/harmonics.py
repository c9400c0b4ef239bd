"""View-dependent colour from spherical harmonics, with gradients."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from ..kernels import harmonics as kernels
from ..kernels.cpu import harmonics as cpu_kernels
from ..kernels.cuda import harmonics as cuda_kernels
from ..kernels.types import LANES
from ..runtime.launch import launch
from . import cuda_blocks, forms
from .forms import GpuForm
from .reduction import sum_rows

MAX_DEGREE = 3


class _SphericalHarmonics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh_dc: Tensor, sh_rest: Tensor, means: Tensor, camera: Tensor, degree: int, form: GpuForm):
        count, rest = sh_rest.shape[:2]
        colors = torch.empty_like(sh_dc)
        flat = sh_rest.view(count * rest, 3)
        seen = means, camera[None], degree, colors
        if form == "cpu":
            blocks = -(-count // LANES)
            launch(cpu_kernels.spherical_harmonics, blocks, sh_dc, flat, rest, *seen, grain=32)
        elif form == "cuda":
            _launch_blocks(cuda_kernels.spherical_harmonics, count, sh_dc, flat, rest, 0, *seen)
        else:
            launch(kernels.spherical_harmonics, count, sh_dc, 1, flat, rest, 0, *seen)
        ctx.save_for_backward(sh_rest, means, camera, colors)
        ctx.degree, ctx.form = degree, form
        return colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_colors: Tensor):  # type: ignore[override]
        sh_rest, means, camera, colors = ctx.saved_tensors
        count, rest = sh_rest.shape[:2]
        _, wants_rest, wants_means, wants_camera, _, _ = ctx.needs_input_grad
        wants_means = (wants_means or wants_camera) and ctx.degree > 0
        v_dc = torch.empty_like(colors)
        v_rest = torch.empty_like(sh_rest) if wants_rest else None
        v_means = torch.empty_like(means) if wants_means else None
        flat = sh_rest.view(count * rest, 3)
        v_flat = v_rest.view(count * rest, 3) if v_rest is not None else None
        seen = means, camera[None], ctx.degree, colors, v_colors.contiguous(), int(wants_rest), int(wants_means)
        outputs = v_dc, v_flat, v_means
        if ctx.form == "cpu":
            blocks = -(-count // LANES)
            launch(cpu_kernels.spherical_harmonics_adjoint, blocks, flat, rest, *seen, *outputs, grain=32)
        elif ctx.form == "cuda":
            _launch_blocks(cuda_kernels.spherical_harmonics_adjoint, count, flat, rest, 0, *seen, *outputs)
        else:
            launch(kernels.spherical_harmonics_adjoint, count, flat, 1, rest, 0, *seen, *outputs)
        return v_dc, v_rest, v_means, _camera_gradient(v_means, wants_camera), None, None


class _WholeHarmonics(torch.autograd.Function):
    """As :class:`_SphericalHarmonics`, with all coefficients in one tensor, [N, K, 3], which is not cut or copied."""

    @staticmethod
    def forward(ctx: Any, sh: Tensor, means: Tensor, camera: Tensor, degree: int, form: GpuForm):
        count, row = sh.shape[:2]
        colors, flat = torch.empty_like(means), sh.view(count * row, 3)
        rows = flat, row, 1, means, camera[None], degree, colors
        if form == "cuda":
            _launch_blocks(cuda_kernels.spherical_harmonics, count, flat, *rows)
        else:
            launch(kernels.spherical_harmonics, count, flat, row, *rows)
        ctx.save_for_backward(sh, means, camera, colors)
        ctx.degree, ctx.form = degree, form
        return colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_colors: Tensor):  # type: ignore[override]
        sh, means, camera, colors = ctx.saved_tensors
        count, row = sh.shape[:2]
        _, wants_means, wants_camera, _, _ = ctx.needs_input_grad
        wants_means = (wants_means or wants_camera) and ctx.degree > 0
        v_sh, v_means = torch.empty_like(sh), torch.empty_like(means) if wants_means else None
        flat, v_flat = sh.view(count * row, 3), v_sh.view(count * row, 3)
        seen = means, camera[None], ctx.degree, colors, v_colors.contiguous(), 1, int(wants_means)
        outputs = v_flat, v_flat, v_means
        if ctx.form == "cuda":
            _launch_blocks(cuda_kernels.spherical_harmonics_adjoint, count, flat, row, 1, *seen, *outputs)
        else:
            launch(kernels.spherical_harmonics_adjoint, count, flat, row, row, 1, *seen, *outputs)
        return v_sh, v_means, _camera_gradient(v_means, wants_camera), None, None


def _launch_blocks(kernel: wp.Kernel, count: int, *args: Any) -> None:
    """Launch a kernel of the form ``cuda`` for ``count`` Gaussians."""
    cuda_blocks.launch_native(kernel, -(-count // cuda_kernels.GAUSSIANS), *args)


def _camera_gradient(v_means: Tensor | None, wanted: bool) -> Tensor | None:
    """Return minus the sum of the means' gradients: the colour depends on mean minus camera alone."""
    return -sum_rows(v_means) if wanted and v_means is not None else None


def whole_harmonics(sh: Tensor, means: Tensor, camera_position: Tensor, degree: int) -> Tensor:
    """Return the colours of :func:`spherical_harmonics` for coefficients [N, K, 3] of all degrees in one tensor.

    On a GPU neither the coefficients nor their gradient are cut into parts, which would copy them.

    Raises:
        ValueError: as :func:`spherical_harmonics`.
    """
    if not sh.is_cuda or not sh.is_contiguous():
        return spherical_harmonics(sh[:, 0], sh[:, 1:], means, camera_position, degree)
    _validate(sh[:, 0], sh[:, 1:], means, degree)
    _validate_camera(camera_position)
    form = forms.chosen_form("auto", sh.device, GpuForm)
    return _WholeHarmonics.apply(sh, means.contiguous(), camera_position.contiguous(), degree, form)  # type: ignore


def spherical_harmonics(
    sh_dc: Tensor, sh_rest: Tensor, means: Tensor, camera_position: Tensor, degree: int, *, form: GpuForm = "auto"
) -> Tensor:
    """Return the colours of Gaussians seen from one point: harmonics + 0.5, clamped at 0 (basis signs as in 3D-GS).

    Args:
        sh_dc: [N, 3] float32, coefficients of degree 0.
        sh_rest: [N, R, 3] float32, coefficients of the higher degrees, R >= (degree + 1)^2 - 1. Coefficients beyond
            ``degree`` get a zero gradient.
        means: [N, 3] float32, world.
        camera_position: [3] float32, world.
        degree: 0 to 3.
        form: kernels to run: ``plain`` on any device, ``cpu`` in SIMD, ``cuda`` on a GPU; ``auto`` takes the fastest
            for the device.

    Returns:
        [N, 3] colours >= 0, or non-finite where a used coefficient is non-finite; ``composite`` leaves such Gaussians
        out. Gradients reach all four tensors, but none passes through a clamped or non-finite channel, and a mean whose
        gradient would overflow gets 0.

    Raises:
        ValueError: a shape is wrong, or the degree is not 0 to 3 or more than ``sh_rest`` has.
    """
    _validate(sh_dc, sh_rest, means, degree)
    _validate_camera(camera_position)
    tensors = (x.contiguous() for x in (sh_dc, sh_rest, means, camera_position))
    form = forms.chosen_form(form, sh_dc.device, GpuForm)
    return _SphericalHarmonics.apply(*tensors, degree, form)  # type: ignore[return-value]


@torch.no_grad()
def colors_and_depths(
    sh_dc: Tensor,
    sh_rest: Tensor,
    means: Tensor,
    viewmat: Tensor,
    depths: Tensor,
    degree: int,
    *,
    form: GpuForm = "auto",
) -> Tensor:
    """Return the colours of :func:`spherical_harmonics` and the depths side by side, [N, 4], without gradients.

    Args:
        viewmat: [4, 4] world-to-camera.
        depths: [N] of the Gaussians.
        form: as for :func:`spherical_harmonics`.

    Raises:
        ValueError: as :func:`spherical_harmonics`, or ``viewmat`` or ``depths`` has a wrong shape.
    """
    _validate(sh_dc, sh_rest, means, degree)
    count, rest = sh_rest.shape[:2]
    if tuple(viewmat.shape) != (4, 4) or tuple(depths.shape) != (count,):
        raise ValueError(f"viewmat must be [4, 4] and depths [{count}], got {[*viewmat.shape]} and {[*depths.shape]}")
    channels = sh_dc.new_empty(count, 4)
    tensors = sh_dc.contiguous(), sh_rest.contiguous().view(count * rest, 3), rest, means.contiguous()
    form = forms.chosen_form(form, sh_dc.device, GpuForm)
    if form == "cpu":
        position = -viewmat[:3, :3].T @ viewmat[:3, 3]
        rows = position[None], depths.contiguous(), degree, channels
        launch(cpu_kernels.channels_with_depth, -(-count // LANES), *tensors, *rows, grain=32)
        return channels
    rows = viewmat.contiguous(), depths.contiguous(), degree, channels
    if form == "cuda":
        _launch_blocks(cuda_kernels.channels_with_depth, count, *tensors, *rows)
    else:
        launch(kernels.channels_with_depth, count, *tensors, *rows)
    return channels


def _validate_camera(camera_position: Tensor) -> None:
    if tuple(camera_position.shape) != (3,):
        raise ValueError(f"camera_position must be [3], got {tuple(camera_position.shape)}")


def _validate(sh_dc: Tensor, sh_rest: Tensor, means: Tensor, degree: int) -> None:
    count = sh_dc.shape[0]
    if sh_dc.ndim != 2 or sh_dc.shape[1] != 3:
        raise ValueError(f"sh_dc must be [N, 3], got {tuple(sh_dc.shape)}")
    if sh_rest.ndim != 3 or sh_rest.shape[0] != count or sh_rest.shape[2] != 3:
        raise ValueError(f"sh_rest must be [{count}, R, 3], got {tuple(sh_rest.shape)}")
    if tuple(means.shape) != (count, 3):
        raise ValueError(f"means must be [{count}, 3], got {tuple(means.shape)}")
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree must be 0 to {MAX_DEGREE}, got {degree}")
    if sh_rest.shape[1] < (degree + 1) ** 2 - 1:
        needed = (degree + 1) ** 2 - 1
        raise ValueError(f"degree {degree} needs {needed} coefficients in sh_rest, got {sh_rest.shape[1]}")
