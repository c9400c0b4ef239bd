"""Bending: posed Gaussians follow control points that an edit has moved further.

Each control point moves its surroundings rigidly: ``x -> R (x - p) + p + t``. A Gaussian blends the motions of its
control points linearly or as dual quaternions (Kavan et al. 2007), which keep volume where the rotations differ. Where
the surface stretches, the Gaussian widens with it, so that no gap opens between it and its neighbours.
"""

import warp as wp

from .quaternion import quat_conjugate, quat_matrix, quat_multiply, quat_normalise, quat_rotate
from .skinning import aligned

wp.set_module_options({"enable_backward": False})

NEGLIGIBLE = wp.constant(1.0e-2)
"""Relative stretch up to which a Gaussian keeps its scales, bit for bit: the decompositions that widen it take most of
the time, and most Gaussians of a bent body stretch by less than a hundredth."""


@wp.func
def pure(v: wp.vec3):
    """Return the quaternion (0, v)."""
    return wp.vec4(0.0, v[0], v[1], v[2])


@wp.func
def largest_bound(S: wp.mat33) -> float:
    """Return what no eigenvalue of a symmetric matrix exceeds (Gershgorin): the largest sum of a diagonal entry and the
    sizes of those beside it."""
    xy = wp.abs(S[0, 1])
    xz = wp.abs(S[0, 2])
    yz = wp.abs(S[1, 2])
    return wp.max(S[0, 0] + xy + xz, wp.max(S[1, 1] + xy + yz, S[2, 2] + xz + yz))


@wp.func
def widening(S: wp.mat33, widest: float):
    """Return the symmetric matrix with the eigenvectors of ``S`` and its eigenvalues, limited to 1 .. widest, and the
    largest of them."""
    Q, values = wp.eig3(S)
    limited = wp.vec3(0.0)
    largest = float(1.0)
    for a in range(3):
        limited[a] = wp.clamp(values[a], 1.0, widest)
        largest = wp.max(largest, limited[a])
    return Q * wp.diag(limited) * wp.transpose(Q), largest


@wp.func
def quat_of(R: wp.mat33):
    """Return the quaternion wxyz of an orthogonal matrix, up to the signs of its columns."""
    proper = R
    if wp.determinant(R) < 0.0:
        for a in range(3):
            proper[a, 2] = -R[a, 2]
    q = wp.quat_from_matrix(proper)
    return quat_normalise(wp.vec4(q[3], q[0], q[1], q[2]))


@wp.kernel
def bend(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N] before the edit
    quats_in: wp.array[wp.vec4],  # [N] wxyz
    scales_in: wp.array[wp.vec3],  # [N]
    nodes_in: wp.array[wp.vec3],  # [M] control points before the edit
    shifts_in: wp.array[wp.vec3],  # [M] their displacements by the edit
    turns_in: wp.array[wp.vec4],  # [M] wxyz, unit, their rotations by the edit
    stretches_in: wp.array[wp.mat33],  # [M] stretch of their surroundings, seen before the rotation
    moved_in: wp.array[wp.int32],  # [M] 1 if the edit moves the control point
    dual: int,  # 1: dual quaternions, 0: linear
    widest: float,  # largest factor by which a Gaussian widens
    indices_in: wp.array2d[wp.int32],  # [N, K]
    weights_in: wp.array2d[float],  # [N, K]
    # Out:
    means_out: wp.array[wp.vec3],  # [N]
    quats_out: wp.array[wp.vec4],  # [N]
    scales_out: wp.array[wp.vec3],  # [N]
    blends_out: wp.array[wp.vec4],  # [N] wxyz, unit: the rotation of each Gaussian by the edit
):
    """Grid: N. Gaussians none of whose control points moves keep their bits."""
    i = first + wp.tid()
    touched = int(0)
    for k in range(indices_in.shape[1]):
        if weights_in[i, k] > 0.0:
            touched = wp.max(touched, moved_in[indices_in[i, k]])
    x = means_in[i]
    means_out[i] = x
    quats_out[i] = quats_in[i]
    scales_out[i] = scales_in[i]
    blends_out[i] = wp.vec4(1.0, 0.0, 0.0, 0.0)
    if touched > 0:
        real = wp.vec4(0.0)
        offset = wp.vec4(0.0)
        shift = wp.vec3(0.0)
        stretch = wp.mat33(0.0)
        reference = wp.vec4(0.0)
        for k in range(indices_in.shape[1]):
            w = weights_in[i, k]
            if w > 0.0:
                m = indices_in[i, k]
                r = turns_in[m]
                p = nodes_in[m]
                step = quat_rotate(r, x - p) + p + shifts_in[m] - x
                if wp.dot(reference, reference) == 0.0:
                    reference = r
                same = w * aligned(r, reference)
                real += same
                offset += 0.5 * quat_multiply(pure(step), same)
                shift += w * step
                stretch += w * stretches_in[m]
        squared = wp.dot(real, real)
        if dual != 0 and squared > 0.0:
            moved = (2.0 / squared) * quat_multiply(offset, quat_conjugate(real))
            shift = wp.vec3(moved[1], moved[2], moved[3])
        turn = quat_normalise(real)
        own = quat_normalise(quats_in[i])
        means_out[i] = x + shift
        blends_out[i] = turn
        quats_out[i] = quat_multiply(turn, own)
        S = 0.5 * (stretch + wp.transpose(stretch))
        if largest_bound(S) > 1.0 + NEGLIGIBLE:
            wide, largest = widening(S, widest)
            if largest > 1.0 + NEGLIGIBLE:
                U, sigma, _V = wp.svd3(quat_matrix(turn) * wide * (quat_matrix(own) * wp.diag(scales_in[i])))
                quats_out[i] = quat_of(U)
                scales_out[i] = sigma
