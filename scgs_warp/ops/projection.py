"""Projection of 3D Gaussians to splats in an image, with gradients."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..kernels import projection as kernels
from ..kernels.cpu import projection as cpu_kernels
from ..runtime.launch import launch
from ..types import Splats
from .forms import Form, chosen_form
from .reduction import sum_rows
from .shapes import check_shapes

MAX_SHARPNESS = 100.0
"""Bound that keeps the powers of the squared distance finite."""


class _Settings(NamedTuple):
    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    antialiased: int
    sharpness: float


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means, quats, scales, opacities, viewmat, K, settings: _Settings, form: Form):
        count, device = means.shape[0], means.device
        means2d = torch.empty(count, 2, device=device)
        conics = torch.empty(count, 3, device=device)
        depths = torch.empty(count, device=device)
        seen = torch.empty(count, device=device)
        radii = torch.empty(count, 2, device=device, dtype=torch.int32)
        inputs = means, quats, scales, opacities, viewmat[None], K[None]
        outputs = means2d, conics, depths, seen, radii
        if form == "cpu":
            blocks = -(-count // cpu_kernels.LANES)
            launch(cpu_kernels.project, blocks, *inputs, *settings, *outputs, grain=32)
        else:
            launch(kernels.project, count, *inputs, *settings, *outputs)
        ctx.save_for_backward(means, quats, scales, opacities, viewmat, K, radii)
        ctx.settings, ctx.form = settings, form
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)
        return means2d, conics, depths, seen, radii

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_means2d, v_conics, v_depths, v_opacities, _):  # type: ignore[override]
        means, quats, scales, opacities, viewmat, K, radii = ctx.saved_tensors
        settings, count = ctx.settings, means.shape[0]
        wants_view = ctx.needs_input_grad[4]
        v_means2d = means.new_zeros(count, 2) if v_means2d is None else v_means2d.contiguous()
        v_conics = means.new_zeros(count, 3) if v_conics is None else v_conics.contiguous()
        v_opacities = means.new_zeros(count) if v_opacities is None else v_opacities.contiguous()
        v_depths = None if v_depths is None else v_depths.contiguous()
        v_inputs = tuple(torch.empty_like(x) for x in (means, quats, scales, opacities))
        v_views = means.new_empty(count, 4, 3) if wants_view else None
        inputs = means, quats, scales, opacities, viewmat[None], K[None]
        camera = settings.width, settings.height, settings.eps2d, settings.antialiased
        incoming = v_means2d, v_conics, v_depths, v_opacities
        known = *inputs, *camera, radii, *incoming
        if ctx.form == "cpu" and not wants_view:
            blocks = -(-count // cpu_kernels.LANES)
            launch(cpu_kernels.project_adjoint, blocks, *known, *v_inputs, grain=32)
        else:
            launch(kernels.project_adjoint, count, *known, int(wants_view), *v_inputs, v_views)
        v_viewmat = None
        if v_views is not None:
            v_viewmat = torch.zeros_like(viewmat)
            v_viewmat[:3] = sum_rows(v_views.view(count, 12)).view(4, 3).T
        return *v_inputs, v_viewmat, None, None, None


def _validate(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, viewmat: Tensor, K: Tensor) -> None:
    if means.ndim != 2 or means.shape[1] != 3:
        raise ValueError(f"means must be [N, 3], got {tuple(means.shape)}")
    count = means.shape[0]
    expected = {
        "quats": (quats, (count, 4)),
        "scales": (scales, (count, 3)),
        "opacities": (opacities, (count,)),
        "viewmat": (viewmat, (4, 4)),
        "K": (K, (3, 3)),
    }
    check_shapes(expected)


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    antialiased: bool = False,
    sharpness: float = 0.0,
    form: Form = "auto",
) -> Splats:
    """Project Gaussians to a pinhole camera's image (EWA splatting, conventions of gsplat 1.5.3).

    A splat ends where its alpha falls under 1/255: ``radii = ceil(sqrt(2 u covariance2d))`` per axis, where
    ``u + sharpness u^2 = ln(255 opacity)``. A Gaussian is culled, with all fields 0 and no gradient, if its depth is
    not between the planes, its splat is off the image, both radii are at most ``radius_clip``, the opacity is under
    1/255, the quaternion is zero, or a value is non-finite.

    Args:
        means: [N, 3] float32, world.
        quats: [N, 4] float32, wxyz, need not be unit.
        scales: [N, 3] float32 > 0, standard deviations, world units.
        opacities: [N] float32 in [0, 1].
        viewmat: [4, 4] float32, world to camera (OpenCV).
        K: [3, 3] float32, pixels; its skew is ignored, and it gets no gradient.
        width: image width, pixels.
        height: image height, pixels.
        near_plane: smallest camera z kept.
        far_plane: largest camera z kept.
        radius_clip: pixels; splats whose radii are not larger are culled.
        eps2d: added to both variances of the 2D covariance, px^2.
        antialiased: multiply the opacity by sqrt(det / det with eps2d) (Mip-Splatting, section 5.2) before the radii
            are computed.
        sharpness: see :class:`Splats`; 0: Gaussians.
        form: kernels to run: ``plain`` on any device, ``cpu`` in SIMD; ``auto`` takes the fastest for the device.

    Returns:
        Splats of this image. Gradients reach means, quats, scales, opacities and viewmat. No gradient passes through
        the clamp of the Jacobian to the frustum widened by 0.3 tan(fov / 2), or to a Gaussian whose gradient overflows.

    Raises:
        ValueError: a shape, a size or the form is wrong.
    """
    _validate(means, quats, scales, opacities, viewmat, K)
    if width <= 0 or height <= 0:
        raise ValueError(f"width and height must be positive, got {width} x {height}")
    if not 0.0 <= sharpness <= MAX_SHARPNESS:
        raise ValueError(f"sharpness must be in 0 .. {MAX_SHARPNESS:g}, got {sharpness}")
    settings = _Settings(
        int(width),
        int(height),
        float(near_plane),
        float(far_plane),
        float(radius_clip),
        float(eps2d),
        int(antialiased),
        float(sharpness),
    )
    tensors = (x.contiguous() for x in (means, quats, scales, opacities, viewmat, K))
    found = _Project.apply(*tensors, settings, chosen_form(form, means.device))
    means2d, conics, depths, seen, radii = found
    return Splats(means2d, conics, depths, seen, radii, settings.width, settings.height, settings.sharpness)
