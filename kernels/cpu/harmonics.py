"""Colour from spherical harmonics on a CPU: 16 Gaussians at a time, with coefficients handled as whole vectors."""

from __future__ import annotations

import warp as wp

from ..native import native_function
from ..types import LANES

wp.set_module_options({"enable_backward": False})

_LANES = wp.constant(LANES)


# fmt: off
@native_function("harmonics.h")
def harmonics_block(
    begin: int, sh_dc: wp.array[wp.vec3], sh_rest: wp.array[wp.vec3], rest: int, means: wp.array[wp.vec3],
    camera: wp.array[wp.vec3], degree: int, colors: wp.array[wp.vec3],
): ...


@native_function("harmonics.h")
def harmonics_block_with_depth(
    begin: int, sh_dc: wp.array[wp.vec3], sh_rest: wp.array[wp.vec3], rest: int, means: wp.array[wp.vec3],
    camera: wp.array[wp.vec3], depths: wp.array[float], degree: int, channels: wp.array[wp.vec4],
): ...


@native_function("harmonics.h")
def harmonics_block_adjoint(
    begin: int, sh_rest: wp.array[wp.vec3], rest: int, means: wp.array[wp.vec3], camera: wp.array[wp.vec3],
    degree: int, colors: wp.array[wp.vec3], v_colors: wp.array[wp.vec3], has_rest: int, has_means: int,
    v_sh_dc: wp.array[wp.vec3], v_sh_rest: wp.array[wp.vec3], v_means: wp.array[wp.vec3],
): ...
# fmt: on


@wp.kernel
def spherical_harmonics(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]
    sh_rest_in: wp.array[wp.vec3],  # [N * R]
    rest: int,  # R
    means_in: wp.array[wp.vec3],  # [N]
    camera_in: wp.array[wp.vec3],  # [1] centre of projection
    degree: int,
    # Out:
    colors_out: wp.array[wp.vec3],  # [N] >= 0, or non-finite where a coefficient is
):
    """Compute the colours of 16 Gaussians. Grid: ceil(N / 16)."""
    begin = (first + wp.tid()) * _LANES
    harmonics_block(begin, sh_dc_in, sh_rest_in, rest, means_in, camera_in, degree, colors_out)


@wp.kernel
def channels_with_depth(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]
    sh_rest_in: wp.array[wp.vec3],  # [N * R]
    rest: int,  # R
    means_in: wp.array[wp.vec3],  # [N]
    camera_in: wp.array[wp.vec3],  # [1] centre of projection
    depths_in: wp.array[float],  # [N]
    degree: int,
    # Out:
    channels_out: wp.array[wp.vec4],  # [N] colour as of spherical_harmonics, and depth
):
    """Compute the colours of 16 Gaussians, and copy their depths beside them. Grid: ceil(N / 16)."""
    begin = (first + wp.tid()) * _LANES
    harmonics_block_with_depth(
        begin, sh_dc_in, sh_rest_in, rest, means_in, camera_in, depths_in, degree, channels_out
    )  # fmt: skip


@wp.kernel
def spherical_harmonics_adjoint(
    first: int,
    # In:
    sh_rest_in: wp.array[wp.vec3],  # [N * R]
    rest: int,  # R
    means_in: wp.array[wp.vec3],  # [N]
    camera_in: wp.array[wp.vec3],  # [1]
    degree: int,
    colors_in: wp.array[wp.vec3],  # [N] of the forward pass: 0 where clamped
    v_colors_in: wp.array[wp.vec3],  # [N]
    has_rest: int,  # whether v_sh_rest_out is wanted
    has_means: int,  # whether v_means_out is wanted
    # Out:
    v_sh_dc_out: wp.array[wp.vec3],  # [N]
    v_sh_rest_out: wp.array[wp.vec3],  # [N * R]
    v_means_out: wp.array[wp.vec3],  # [N]; the camera's is minus their sum
):
    """Compute the gradients of 16 Gaussians. Grid: ceil(N / 16)."""
    harmonics_block_adjoint(
        (first + wp.tid()) * _LANES, sh_rest_in, rest, means_in, camera_in, degree, colors_in, v_colors_in, has_rest,
        has_means, v_sh_dc_out, v_sh_rest_out, v_means_out,
    )  # fmt: skip
