"""3D covariance of a Gaussian from its quaternion and scales: ``R S S^T R^T`` (3D-GS, section 4, equation 6)."""

import warp as wp

from .quaternion import quat_matrix, quat_matrix_adjoint, quat_normalise, quat_normalise_adjoint

wp.set_module_options({"enable_backward": False})


@wp.func
def finite_or_zero(m: wp.mat33) -> wp.mat33:
    """The matrix, or zero where an entry is not finite."""
    for r in range(3):
        for c in range(3):
            if not wp.isfinite(m[r, c]):
                return wp.mat33(0.0)
    return m


@wp.kernel
def covariance(
    first: int,
    # In:
    quats_in: wp.array[wp.vec4],  # [N] wxyz, any norm
    scales_in: wp.array[wp.vec3],  # [N] standard deviations
    # Out:
    covariances_out: wp.array[wp.mat33],  # [N]
):
    i = first + wp.tid()
    axes = quat_matrix(quat_normalise(quats_in[i])) * wp.diag(scales_in[i])
    covariances_out[i] = finite_or_zero(axes * wp.transpose(axes))


@wp.kernel
def covariance_adjoint(
    first: int,
    # In:
    quats_in: wp.array[wp.vec4],  # [N]
    scales_in: wp.array[wp.vec3],  # [N]
    v_covariances_in: wp.array[wp.mat33],  # [N], need not be symmetric
    # Out:
    v_quats_out: wp.array[wp.vec4],  # [N]
    v_scales_out: wp.array[wp.vec3],  # [N]
):
    i = first + wp.tid()
    quat = quats_in[i]
    scale = scales_in[i]
    unit = quat_normalise(quat)
    rotation = quat_matrix(unit)
    v = v_covariances_in[i]
    v_axes = (v + wp.transpose(v)) * rotation * wp.diag(scale)
    projected = wp.transpose(rotation) * v_axes
    v_scale = wp.vec3(projected[0, 0], projected[1, 1], projected[2, 2])
    v_unit = quat_matrix_adjoint(unit, v_axes * wp.diag(scale))
    v_quat = quat_normalise_adjoint(quat, v_unit)
    # What is not finite, or overflows, passes none. A sum of finite terms is finite unless it is beyond use.
    total = v_quat[0] + v_quat[1] + v_quat[2] + v_quat[3]
    for c in range(3):
        total += scale[c] + v_scale[c]
    if not wp.isfinite(total):
        v_scale = wp.vec3(0.0)
        v_quat = wp.vec4(0.0)
    v_scales_out[i] = v_scale
    v_quats_out[i] = v_quat
