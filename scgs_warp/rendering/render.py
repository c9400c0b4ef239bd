"""One image of the Gaussians at one instant: project, colour, bin, composite."""

from __future__ import annotations

from collections.abc import Callable
from math import isqrt
from typing import Any

import torch
from torch import Tensor

from ..kernels import compositing as kernels
from ..ops.binning import bin_splats
from ..ops.compositing import composite, demand
from ..ops.harmonics import MAX_DEGREE, colors_and_depths, spherical_harmonics
from ..ops.projection import project
from ..runtime.launch import launch
from ..types import Camera, Gaussians, Image, Splats, Stats, Tiles


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Tensor | None = None,
    *,
    sh_degree: int | None = None,
    stats: Stats | None = None,
    antialiased: bool = False,
    depth_unit: float = 1.0,
) -> Image:
    """Render colour and expected depth in one pass (3D Gaussian Splatting, Kerbl et al. 2023, section 4).

    Args:
        gaussians: N activated Gaussians in world units; N may be 0.
        camera: viewpoint, on the device of the Gaussians.
        background: [3] colour behind everything. None: black.
        sh_degree: degree of the harmonics used. None: the highest one present.
        stats: statistics to which the backward pass adds. None: they are not collected.
        antialiased: Mip-Splatting's opacity compensation.
        depth_unit: length of the resulting depth's unit, in units of the Gaussians.

    Returns:
        Image: ``rgb`` [H, W, 3] (its planar permutation is contiguous), ``alpha`` [H, W], ``depth`` [H, W] along the
        camera's z. Colour and depth share their memory. Gradients reach ``gaussians``, ``camera.viewmat`` and
        ``background``.

    Raises:
        ValueError: a shape, a size or the degree is wrong.
    """
    unit = None if torch.is_grad_enabled() else depth_unit
    settings: dict[str, Any] = {"sh_degree": sh_degree, "stats": stats, "antialiased": antialiased}
    image, alpha = draw(gaussians, camera, background, **settings, depth=True, depth_unit=unit)
    depth = expected_depth(image[3], alpha, depth_unit) if unit is None else image[3]
    return Image(image[:3].permute(1, 2, 0), alpha, depth)


def draw(
    gaussians: Gaussians,
    camera: Camera,
    background: Tensor | None = None,
    *,
    sh_degree: int | None = None,
    stats: Stats | None = None,
    antialiased: bool = False,
    depth: bool = False,
    depth_unit: float | None = None,
    binned: Callable[[Splats], Tiles] | None = None,
) -> tuple[Tensor, Tensor]:
    """Render as :func:`render` does, to planar images, with depth only on request, which saves its cost in training.

    Args:
        background: [3], or with ``depth`` also [4].
        depth: append the depth accumulated over the pixel, in world units times alpha, as a fourth channel.
        depth_unit: with ``depth``, append the expected depth instead, in this unit; only without gradients.
        binned: function that lists the splats of each tile. None: ``bin_splats``.

    Returns:
        image [3 or 4, H, W] and alpha [H, W].
    """
    if depth_unit is not None and not depth:
        raise ValueError("depth_unit needs depth=True")
    if background is not None and tuple(background.shape) not in ((3,), (3 + depth,)):
        raise ValueError(f"background must be [3], got {tuple(background.shape)}")
    if sh_degree is None:
        sh_degree = min(isqrt(gaussians.sh_rest.shape[1] + 1) - 1, MAX_DEGREE)
    means = gaussians.means
    shape = gaussians.quats, gaussians.scales, gaussians.opacities
    size = camera.width, camera.height
    splats = project(
        means, *shape, camera.viewmat, camera.K, *size, antialiased=antialiased, sharpness=gaussians.sharpness
    )
    harmonics = gaussians.sh_dc, gaussians.sh_rest, means
    if depth and not torch.is_grad_enabled():
        channels = colors_and_depths(*harmonics, camera.viewmat, splats.depths, sh_degree)
    else:
        channels = spherical_harmonics(*harmonics, centre_of(camera), sh_degree)
        channels = torch.cat([channels, splats.depths[:, None]], dim=1) if depth else channels
    if depth and background is not None and len(background) == 3:
        background = torch.cat([background, background.new_zeros(1)])
    beside = demand(splats, channels, background)
    tiles = bin_splats(splats, demand=beside, slots=torch.is_grad_enabled()) if binned is None else binned(splats)
    return composite(splats, channels, tiles, background, stats=stats, depth_unit=depth_unit)


class _FiniteGradient(torch.autograd.Function):
    """Identity function that replaces non-finite gradients by 0."""

    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        return value.view_as(value)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # type: ignore[override]
        return gradient.nan_to_num(0.0, 0.0, 0.0)


def centre_of(camera: Camera) -> Tensor:
    """Return ``camera.position``, [3]; its gradient is 0 where a non-finite viewmat (zero times NaN) would give NaN."""
    if not camera.viewmat.requires_grad:
        return camera.position
    viewmat: Tensor = _FiniteGradient.apply(camera.viewmat)  # type: ignore[assignment]
    return Camera(viewmat, camera.K, camera.width, camera.height).position


def expected_depth(accumulated: Tensor, alpha: Tensor, unit: float = 1.0) -> Tensor:
    """Return accumulated depth over alpha, and 0 where alpha is 0; the shapes of all three are equal.

    Args:
        unit: divisor of the result, the number of the Gaussians' units in a unit of the caller's.
    """
    if torch.is_grad_enabled():
        depth = accumulated / alpha.clamp_min(1e-10)
        return depth if unit == 1.0 else (depth.double() / unit).to(depth.dtype)
    depth = torch.empty_like(alpha)
    pixels = accumulated.contiguous().flatten(), alpha.contiguous().flatten(), unit, depth.view(-1)
    launch(kernels.expected_depth, depth.numel(), *pixels)
    return depth
