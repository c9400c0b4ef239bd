"""A kernel that does nothing but call the functions of ``kernels/quaternion.py``, for their test."""

import warp as wp

from scgs_warp.kernels.quaternion import (
    quat_conjugate,
    quat_matrix,
    quat_matrix_adjoint,
    quat_multiply,
    quat_normalise,
    quat_normalise_adjoint,
    quat_rotate,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def products(
    first: int,
    # In:
    a_in: wp.array[wp.vec4],  # [N]
    b_in: wp.array[wp.vec4],  # [N]
    x_in: wp.array[wp.vec3],  # [N]
    v_quat_in: wp.array[wp.vec4],  # [N]
    v_vec_in: wp.array[wp.vec3],  # [N]
    # Out:
    product_out: wp.array[wp.vec4],  # [N] a b
    v_a_out: wp.array[wp.vec4],  # [N]
    v_b_out: wp.array[wp.vec4],  # [N]
    unit_out: wp.array[wp.vec4],  # [N] a / |a|
    v_raw_out: wp.array[wp.vec4],  # [N] gradient to a of unit and rotated
    rotated_out: wp.array[wp.vec3],  # [N] R(unit) x
    v_x_out: wp.array[wp.vec3],  # [N]
):
    i = first + wp.tid()
    a = a_in[i]
    product_out[i] = quat_multiply(a, b_in[i])
    v_a_out[i] = quat_multiply(v_quat_in[i], quat_conjugate(b_in[i]))
    v_b_out[i] = quat_multiply(quat_conjugate(a), v_quat_in[i])
    unit = quat_normalise(a)
    unit_out[i] = unit
    rotated_out[i] = quat_rotate(unit, x_in[i])
    v_unit = quat_matrix_adjoint(unit, wp.outer(v_vec_in[i], x_in[i]))
    v_x_out[i] = wp.transpose(quat_matrix(unit)) * v_vec_in[i]
    v_raw_out[i] = quat_normalise_adjoint(a, v_unit + v_quat_in[i])
