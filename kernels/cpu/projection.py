"""Projection on a CPU: sixteen Gaussians at a time, one in each SIMD lane, by the formulas of ``projection``."""

from __future__ import annotations

import warp as wp

from ..native import native_function
from ..types import LANES

wp.set_module_options({"enable_backward": False})


# fmt: off
@native_function("projection.h")
def _project(
    begin: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], scales: wp.array[wp.vec3],
    opacities: wp.array[float], viewmat: wp.array[wp.mat44], intrinsics: wp.array[wp.mat33], width: int, height: int,
    near_plane: float, far_plane: float, radius_clip: float, eps2d: float, antialiased: int, sharpness: float,
    means2d: wp.array[wp.vec2], conics: wp.array[wp.vec3], depths: wp.array[float], opacities_out: wp.array[float],
    radii: wp.array[wp.vec2i],
): ...


@native_function("projection.h")
def _project_adjoint(
    begin: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], scales: wp.array[wp.vec3],
    opacities: wp.array[float], viewmat: wp.array[wp.mat44], intrinsics: wp.array[wp.mat33], width: int, height: int,
    eps2d: float, antialiased: int, radii: wp.array[wp.vec2i], v_means2d: wp.array[wp.vec2],
    v_conics: wp.array[wp.vec3], v_depths: wp.array[float], v_opacities: wp.array[float], v_means: wp.array[wp.vec3],
    v_quats: wp.array[wp.vec4], v_scales: wp.array[wp.vec3], v_opacities_out: wp.array[float],
): ...
# fmt: on


@wp.kernel
def project(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N] wxyz, any norm
    scales_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    viewmat_in: wp.array[wp.mat44],  # [1] world-to-camera
    K_in: wp.array[wp.mat33],  # [1]
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
    antialiased: int,
    sharpness: float,
    # Out: (all zero where culled)
    means2d_out: wp.array[wp.vec2],  # [N]
    conics_out: wp.array[wp.vec3],  # [N]
    depths_out: wp.array[float],  # [N]
    opacities_out: wp.array[float],  # [N]
    radii_out: wp.array[wp.vec2i],  # [N]
):
    """Project Gaussians ``16 i .. 16 i + 15``."""
    _project(
        (first + wp.tid()) * LANES, means_in, quats_in, scales_in, opacities_in, viewmat_in, K_in, width, height,
        near_plane, far_plane, radius_clip, eps2d, antialiased, sharpness, means2d_out, conics_out, depths_out,
        opacities_out, radii_out,
    )  # fmt: skip


@wp.kernel
def project_adjoint(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N]
    scales_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    viewmat_in: wp.array[wp.mat44],  # [1]
    K_in: wp.array[wp.mat33],  # [1]
    width: int,
    height: int,
    eps2d: float,
    antialiased: int,
    radii_in: wp.array[wp.vec2i],  # [N] of the forward pass: (0, 0) where culled
    v_means2d_in: wp.array[wp.vec2],  # [N]
    v_conics_in: wp.array[wp.vec3],  # [N]
    v_depths_in: wp.array[float],  # [N], null: zero
    v_opacities_in: wp.array[float],  # [N]
    # Out:
    v_means_out: wp.array[wp.vec3],  # [N]
    v_quats_out: wp.array[wp.vec4],  # [N]
    v_scales_out: wp.array[wp.vec3],  # [N]
    v_opacities_out: wp.array[float],  # [N]
):
    """Compute the gradients of Gaussians ``16 i .. 16 i + 15``. The portable adjoint computes the camera's."""
    _project_adjoint(
        (first + wp.tid()) * LANES, means_in, quats_in, scales_in, opacities_in, viewmat_in, K_in, width, height,
        eps2d, antialiased, radii_in, v_means2d_in, v_conics_in, v_depths_in, v_opacities_in, v_means_out, v_quats_out,
        v_scales_out, v_opacities_out,
    )  # fmt: skip
