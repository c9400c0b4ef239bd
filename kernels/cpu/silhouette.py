"""Distances between spheres and a silhouette on a CPU: 16 spheres or pixels at a time, one in each SIMD lane."""

import warp as wp

from ..native import native_function
from ..types import LANES

wp.set_module_options({"enable_backward": False})

_LANES = wp.constant(LANES)


# fmt: off
@native_function("silhouette.h")
def _project_spheres(
    begin: int, means: wp.array[wp.vec3], viewmat: wp.array[wp.mat44], intrinsics: wp.array[wp.mat33], width: int,
    distances: wp.array2d[float], size: wp.array[float], points: wp.array[wp.vec2], slopes: wp.array[wp.vec2],
    parts: wp.array[float],
): ...


@native_function("silhouette.h")
def _nearest_spheres(
    begin: int, points: wp.array[wp.vec2], pixels: wp.array[wp.vec2], indices: wp.array[wp.int32],
    directions: wp.array[wp.vec2], parts: wp.array[float],
): ...


@native_function("silhouette.h")
def _project_spheres_adjoint(
    begin: int, means: wp.array[wp.vec3], viewmat: wp.array[wp.mat44], intrinsics: wp.array[wp.mat33], width: int,
    slopes: wp.array[wp.vec2], indices: wp.array[wp.int32], directions: wp.array[wp.vec2], v_term: wp.array[float],
    v_means: wp.array[wp.vec3],
): ...
# fmt: on


@wp.kernel
def project_spheres(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N] centres
    viewmat_in: wp.array[wp.mat44],  # [1] world-to-camera
    K_in: wp.array[wp.mat33],  # [1] pixels
    width: int,  # of the image, pixels
    distances_in: wp.array2d[float],  # [h, w] distances to the silhouette
    size_in: wp.array[float],  # [2] width and height of the table
    # Out:
    points_out: wp.array[wp.vec2],  # [N] projected centres
    slopes_out: wp.array[wp.vec2],  # [N] gradients of the sampled distances
    parts_out: wp.array[float],  # [N + P] the first N: distances to the silhouette, divided by N
):
    """Project 16 centres and sample the table there. Grid: ceil(N / 16)."""
    begin = (first + wp.tid()) * _LANES
    _project_spheres(
        begin, means_in, viewmat_in, K_in, width, distances_in, size_in, points_out, slopes_out, parts_out
    )  # fmt: skip


@wp.kernel
def nearest_spheres(
    first: int,
    # In:
    points_in: wp.array[wp.vec2],  # [N] projected centres
    pixels_in: wp.array[wp.vec2],  # [P] of the silhouette
    # Out:
    indices_out: wp.array[wp.int32],  # [P] nearest centre, the first of several
    directions_out: wp.array[wp.vec2],  # [P] unit, from the pixel to the centre; 0 where they coincide
    parts_out: wp.array[float],  # [N + P] the last P: distances to the nearest centre, divided by P
):
    """Find the centres that are nearest to 16 pixels. Grid: ceil(P / 16)."""
    _nearest_spheres((first + wp.tid()) * _LANES, points_in, pixels_in, indices_out, directions_out, parts_out)


@wp.kernel
def project_spheres_adjoint(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    viewmat_in: wp.array[wp.mat44],  # [1]
    K_in: wp.array[wp.mat33],  # [1]
    width: int,
    slopes_in: wp.array[wp.vec2],  # [N]
    indices_in: wp.array[wp.int32],  # [P]
    directions_in: wp.array[wp.vec2],  # [P]
    v_term_in: wp.array[float],  # [1] gradient of the sum of all parts
    # Out:
    v_means_out: wp.array[wp.vec3],  # [N]
):
    """Compute the gradients of 16 centres. Grid: ceil(N / 16)."""
    begin = (first + wp.tid()) * _LANES
    _project_spheres_adjoint(
        begin, means_in, viewmat_in, K_in, width, slopes_in, indices_in, directions_in, v_term_in, v_means_out
    )  # fmt: skip
