"""Pose-dependent correctives on a CPU: 16 Gaussians at a time, one in each SIMD lane."""

import warp as wp

from ..native import native_function
from ..types import LANES

wp.set_module_options({"enable_backward": False})

_LANES = wp.constant(LANES)


# fmt: off
@native_function("correctives.h")
def correct_block(
    begin: int, means: wp.array[wp.vec3], correctives: wp.array2d[float], quats: wp.array[wp.vec4],
    quats_t: wp.array[wp.vec4], quats_own: wp.array[wp.vec4], has_own: int, means_t: wp.array[wp.vec3],
): ...


@native_function("correctives.h")
def correct_block_adjoint(
    begin: int, correctives: wp.array2d[float], quats: wp.array[wp.vec4], quats_t: wp.array[wp.vec4],
    quats_own: wp.array[wp.vec4], has_own: int, v_means_t: wp.array[wp.vec3], v_correctives: wp.array2d[float],
): ...
# fmt: on


@wp.kernel
def correct(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N] skinned
    correctives_in: wp.array2d[float],  # [N, 27] C by rows
    quats_in: wp.array[wp.vec4],  # [N] at rest, any norm
    quats_t_in: wp.array[wp.vec4],  # [N] posed, any norm
    quats_own_in: wp.array[wp.vec4],  # [N] that determine the displacement, touched only with has_own
    has_own: int,  # 0: the posed ones do
    # Out:
    means_out: wp.array[wp.vec3],  # [N]
):
    """Add the correctives to 16 means. Grid: ceil(N / 16)."""
    begin = (first + wp.tid()) * _LANES
    correct_block(begin, means_in, correctives_in, quats_in, quats_t_in, quats_own_in, has_own, means_out)


@wp.kernel
def correct_adjoint(
    first: int,
    # In:
    correctives_in: wp.array2d[float],  # [N, 27]
    quats_in: wp.array[wp.vec4],  # [N]
    quats_t_in: wp.array[wp.vec4],  # [N]
    quats_own_in: wp.array[wp.vec4],  # [N], touched only with has_own
    has_own: int,
    v_means_t_in: wp.array[wp.vec3],  # [N]
    # Out:
    v_correctives_out: wp.array2d[float],  # [N, 27]
):
    """Compute the gradients of 16 matrices C. Grid: ceil(N / 16)."""
    begin = (first + wp.tid()) * _LANES
    correct_block_adjoint(
        begin, correctives_in, quats_in, quats_t_in, quats_own_in, has_own, v_means_t_in, v_correctives_out
    )
