"""Quaternion functions for other kernels, ``wxyz`` in a ``wp.vec4`` (``wp.quat`` is xyzw), and their adjoints.

An adjoint takes the inputs of its function and the gradient of its result, and returns the gradients of the inputs.
``quat_matrix`` and ``quat_rotate`` are polynomials, which give rotations for unit quaternions only. Their adjoints are
exact derivatives of these polynomials, so chaining them with ``quat_normalise_adjoint`` is exact, too.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def quat_inverse_norm(q: wp.vec4) -> float:
    """Return 1 / |q|, or 0 where |q|^2 is 0 or NaN."""
    squared = wp.dot(q, q)
    inverse = float(0.0)
    if squared > 0.0:
        inverse = 1.0 / wp.sqrt(squared)
    return inverse


@wp.func
def quat_normalise(q: wp.vec4) -> wp.vec4:
    """Return q / |q|, or the identity for a quaternion of norm 0."""
    inverse = quat_inverse_norm(q)
    unit = wp.vec4(1.0, 0.0, 0.0, 0.0)
    if inverse > 0.0:
        unit = inverse * q
    return unit


@wp.func
def quat_normalise_adjoint(q: wp.vec4, v_unit: wp.vec4) -> wp.vec4:
    """Return the gradient of q; it is 0 for a quaternion of norm 0, which normalises to a constant."""
    inverse = quat_inverse_norm(q)
    unit = inverse * q
    return inverse * (v_unit - wp.dot(unit, v_unit) * unit)


@wp.func
def quat_multiply(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """Return the Hamilton product a b, which rotates by b, then by a."""
    return wp.vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def quat_conjugate(q: wp.vec4) -> wp.vec4:
    return wp.vec4(q[0], -q[1], -q[2], -q[3])


@wp.func
def quat_matrix(q: wp.vec4) -> wp.mat33:
    """Return the rotation matrix of a unit quaternion."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@wp.func
def quat_matrix_adjoint(q: wp.vec4, v: wp.mat33) -> wp.vec4:
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return 2.0 * wp.vec4(
        x * (v[2, 1] - v[1, 2]) + y * (v[0, 2] - v[2, 0]) + z * (v[1, 0] - v[0, 1]),
        -2.0 * x * (v[1, 1] + v[2, 2]) + y * (v[1, 0] + v[0, 1]) + z * (v[2, 0] + v[0, 2]) + w * (v[2, 1] - v[1, 2]),
        x * (v[1, 0] + v[0, 1]) - 2.0 * y * (v[0, 0] + v[2, 2]) + z * (v[2, 1] + v[1, 2]) + w * (v[0, 2] - v[2, 0]),
        x * (v[2, 0] + v[0, 2]) + y * (v[2, 1] + v[1, 2]) - 2.0 * z * (v[0, 0] + v[1, 1]) + w * (v[1, 0] - v[0, 1]),
    )


@wp.func
def quat_rotate(q: wp.vec4, x: wp.vec3) -> wp.vec3:
    """Return R(q) x for a unit quaternion."""
    return quat_matrix(q) * x


@wp.func
def rotation_between(quat: wp.vec4, quat_t: wp.vec4) -> wp.mat33:
    """Return the rotation R from ``quat`` to ``quat_t``, of any norm."""
    return quat_matrix(quat_multiply(quat_normalise(quat_t), quat_conjugate(quat_normalise(quat))))
