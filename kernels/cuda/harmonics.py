"""Colour from spherical harmonics on CUDA, in native code: a block of 256 threads per 128 Gaussians.

In ``harmonics`` each thread reads and writes rows of up to 192 bytes, so the threads of a warp access as many places as
there are threads, and each access carries a part of what it moves. Here all threads of a block copy its rows between
global and shared memory, neighbouring threads neighbouring addresses: in pieces of 16 bytes where a row has an odd
number of floats and all of them are used (the 45 of degree 3), else in pieces of 4, a warp per row. Then 128 threads
compute, each from a row in shared memory, and the adjoint writes the gradients there, over the coefficients. Rows of
Gaussians whose gradient is zero are not read. With 256 Gaussians, shared memory would hold half as many blocks.

On a CPU the native functions are empty; tests compile them with a shim that runs a block's threads as fibres.
"""

from __future__ import annotations

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False})

BLOCK_DIM = 256
GAUSSIANS = 128
"""Gaussians per block."""
_BOUNDS = (BLOCK_DIM, 6)
"""Launch bounds: threads per block, and blocks per multiprocessor. They leave 40 registers to each thread, which spills
nothing; eight blocks would."""


# fmt: off
@native_function("harmonics_cuda.h", device="cuda")
def harmonics_of_block(
    block: int, sh_dc: wp.array[wp.vec3], sh_rest: wp.array[wp.vec3], rest_row: int, rest_begin: int,
    means: wp.array[wp.vec3], camera: wp.array[wp.vec3], degree: int, colors: wp.array[wp.vec3],
): ...


@native_function("harmonics_cuda.h", device="cuda")
def channels_of_block(
    block: int, sh_dc: wp.array[wp.vec3], sh_rest: wp.array[wp.vec3], rest_row: int, means: wp.array[wp.vec3],
    viewmat: wp.array2d[float], depths: wp.array[float], degree: int, channels: wp.array2d[float],
): ...


@native_function("harmonics_cuda.h", device="cuda")
def harmonics_of_block_adjoint(
    block: int, sh_rest: wp.array[wp.vec3], rest_row: int, rest_begin: int, means: wp.array[wp.vec3],
    camera: wp.array[wp.vec3], degree: int, colors: wp.array[wp.vec3], v_colors: wp.array[wp.vec3], has_rest: int,
    has_means: int, v_sh_dc: wp.array[wp.vec3], v_sh_rest: wp.array[wp.vec3], v_means: wp.array[wp.vec3],
): ...
# fmt: on


@wp.kernel(launch_bounds=_BOUNDS)
def spherical_harmonics(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]; not read if rest_begin is 1
    sh_rest_in: wp.array[wp.vec3],  # [N * rest_row]
    rest_row: int,  # a Gaussian's part of sh_rest_in
    rest_begin: int,  # where the higher coefficients begin in it: 0, or 1 after that of degree 0
    means_in: wp.array[wp.vec3],  # [N]
    camera_in: wp.array[wp.vec3],  # [1] centre of projection
    degree: int,
    # Out:
    colors_out: wp.array[wp.vec3],  # [N] >= 0, or non-finite where a coefficient is
):
    """Compute the colours of 128 Gaussians per block. Grid: ceil(N / 128) x 256."""
    block, _lane = wp.tid()
    harmonics_of_block(
        first + block, sh_dc_in, sh_rest_in, rest_row, rest_begin, means_in, camera_in, degree, colors_out
    )  # fmt: skip


@wp.kernel(launch_bounds=_BOUNDS)
def channels_with_depth(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]
    sh_rest_in: wp.array[wp.vec3],  # [N * R]
    rest: int,  # R
    means_in: wp.array[wp.vec3],  # [N]
    viewmat_in: wp.array2d[float],  # [4, 4]
    depths_in: wp.array[float],  # [N]
    degree: int,
    # Out:
    channels_out: wp.array2d[float],  # [N, 4] colour as of spherical_harmonics, and depth
):
    """Compute the colours of 128 Gaussians per block, and copy their depths beside them. Grid: ceil(N / 128) x 256."""
    block, _lane = wp.tid()
    channels_of_block(
        first + block, sh_dc_in, sh_rest_in, rest, means_in, viewmat_in, depths_in, degree, channels_out
    )  # fmt: skip


@wp.kernel(launch_bounds=_BOUNDS)
def spherical_harmonics_adjoint(
    first: int,
    # In:
    sh_rest_in: wp.array[wp.vec3],  # [N * rest_row]
    rest_row: int,  # as in the forward pass, for coefficients and gradients
    rest_begin: int,
    means_in: wp.array[wp.vec3],  # [N]
    camera_in: wp.array[wp.vec3],  # [1]
    degree: int,
    colors_in: wp.array[wp.vec3],  # [N] of the forward pass: 0 where clamped
    v_colors_in: wp.array[wp.vec3],  # [N]
    has_rest: int,  # whether v_sh_rest_out is wanted
    has_means: int,  # whether v_means_out is wanted
    # Out:
    v_sh_dc_out: wp.array[wp.vec3],  # [N]; not written if rest_begin is 1
    v_sh_rest_out: wp.array[wp.vec3],  # [N * rest_row]
    v_means_out: wp.array[wp.vec3],  # [N]; the camera's is minus their sum
):
    """Compute the gradients of 128 Gaussians per block. Grid: ceil(N / 128) x 256."""
    block, _lane = wp.tid()
    harmonics_of_block_adjoint(
        first + block, sh_rest_in, rest_row, rest_begin, means_in, camera_in, degree, colors_in, v_colors_in, has_rest,
        has_means, v_sh_dc_out, v_sh_rest_out, v_means_out,
    )  # fmt: skip
