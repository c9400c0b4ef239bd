"""Linear blend skinning of Gaussians by their control points (SC-GS, Eq. 6 and 7).

On a CPU the kernels of ``cpu/skinning*.py`` run instead, except for sizes beyond their limits and for gradients with
respect to given weights.

The adjoint runs in three steps: ``skin_adjoint`` computes each Gaussian's own gradients, the second step sums over each
node's Gaussians (by chunks of Gaussians on a CPU, by segments of all pairs in ``cuda/node_sums.py``), and
``skin_finish`` computes each node's gradients from its sums. The rotation's gradient is summed as the matrix
``G = sum w v (x - p)^T`` and converted to the quaternion's gradient once per node.

Extras are three more values per node, blended linearly: changes of log scales, or tints.
"""

import warp as wp

from .gradient_limits import beyond, near, passed
from .quaternion import (
    quat_conjugate,
    quat_matrix_adjoint,
    quat_multiply,
    quat_normalise,
    quat_normalise_adjoint,
    quat_rotate,
)

wp.set_module_options({"enable_backward": False})

SUMS = 16
"""Number of columns of the node sums: G (9), w v (3), w s v_blend (4); with extras 3 more, w v_extras. w is the
weight, v the gradient of the moved mean, and s = +-1 the sign that aligns the quaternion."""


@wp.func
def aligned(q: wp.vec4, reference: wp.vec4):
    """Return q or -q, whichever has a non-negative dot product with the reference."""
    if wp.dot(q, reference) < 0.0:
        return -q
    return q


@wp.func
def finite(x: wp.vec3):
    return wp.isfinite(x[0]) and wp.isfinite(x[1]) and wp.isfinite(x[2])


@wp.func
def finite(q: wp.vec4):  # noqa: F811  (Warp overloads by type)
    return wp.isfinite(q[0]) and wp.isfinite(q[1]) and wp.isfinite(q[2]) and wp.isfinite(q[3])


@wp.func
def skinned(
    i: int,
    x: wp.vec3,
    nodes: wp.array[wp.vec3],
    translations: wp.array[wp.vec3],
    rotations: wp.array[wp.vec4],
    shape_rotations: wp.array[wp.vec4],
    extras: wp.array[wp.vec3],
    has_extras: int,
    indices: wp.array2d[wp.int32],
    weights: wp.array2d[float],
):
    """Return the moved mean of Gaussian i, which rests at x, the blended rotation of its shape, which is not unit, and
    its extras."""
    mean = wp.vec3(0.0)
    blend = wp.vec4(0.0)
    extra = wp.vec3(0.0)
    reference = wp.vec4(0.0)
    for k in range(indices.shape[1]):
        m = indices[i, k]
        w = weights[i, k]
        r = quat_normalise(rotations[m])
        p = nodes[m]
        mean += w * (quat_rotate(r, x - p) + p + translations[m])
        shape = quat_normalise(shape_rotations[m])
        if k == 0:
            reference = shape
        blend += w * aligned(shape, reference)
        if has_extras != 0:
            extra += w * extras[m]
    return mean, blend, extra


@wp.kernel
def skin(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N] wxyz
    nodes_in: wp.array[wp.vec3],  # [M]
    translations_in: wp.array[wp.vec3],  # [M]
    rotations_in: wp.array[wp.vec4],  # [M] wxyz
    shape_rotations_in: wp.array[wp.vec4],  # [M] wxyz, the same array as rotations_in where there are none
    extras_in: wp.array[wp.vec3],  # [M], touched only with has_extras
    has_extras: int,
    indices_in: wp.array2d[wp.int32],  # [N, K]
    weights_in: wp.array2d[float],  # [N, K]
    # Out:
    means_out: wp.array[wp.vec3],  # [N]
    quats_out: wp.array[wp.vec4],  # [N] unit
    extras_out: wp.array[wp.vec3],  # [N], touched only with has_extras
):
    i = first + wp.tid()
    mean, blend, extra = skinned(
        i,
        means_in[i],
        nodes_in,
        translations_in,
        rotations_in,
        shape_rotations_in,
        extras_in,
        has_extras,
        indices_in,
        weights_in,
    )
    means_out[i] = mean
    quats_out[i] = quat_multiply(quat_normalise(blend), quat_normalise(quats_in[i]))
    if has_extras != 0:
        extras_out[i] = extra


@wp.kernel
def skin_adjoint(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N]
    nodes_in: wp.array[wp.vec3],  # [M]
    translations_in: wp.array[wp.vec3],  # [M]
    rotations_in: wp.array[wp.vec4],  # [M]
    shape_rotations_in: wp.array[wp.vec4],  # [M]
    extras_in: wp.array[wp.vec3],  # [M], touched only with has_extras
    has_extras: int,
    indices_in: wp.array2d[wp.int32],  # [N, K]
    weights_in: wp.array2d[float],  # [N, K]
    v_means_in: wp.array[wp.vec3],  # [N]
    v_quats_in: wp.array[wp.vec4],  # [N]
    v_extras_in: wp.array[wp.vec3],  # [N], touched only with has_extras
    # Out:
    v_means_out: wp.array[wp.vec3],  # [N]
    v_quats_out: wp.array[wp.vec4],  # [N]
    v_weights_out: wp.array2d[float],  # [N, K]
    v_blends_out: wp.array[wp.vec4],  # [N] gradient to the blended rotation before it is normalised; NaN: passes none
):
    """Compute the gradients of one Gaussian's own values.

    A Gaussian that is non-finite, or that a non-finite control point moves, passes no gradient.
    """
    i = first + wp.tid()
    x = means_in[i]
    v = v_means_in[i]
    K = indices_in.shape[1]
    if not (near(x) and finite(quats_in[i])):
        v_means_out[i] = wp.vec3(0.0)
        v_quats_out[i] = wp.vec4(0.0)
        v_blends_out[i] = wp.vec4(wp.nan)
        for k in range(K):
            v_weights_out[i, k] = 0.0
        return
    reference = quat_normalise(shape_rotations_in[indices_in[i, 0]])
    blend = wp.vec4(0.0)
    for k in range(K):
        shape = quat_normalise(shape_rotations_in[indices_in[i, k]])
        blend += weights_in[i, k] * aligned(shape, reference)
    b = quat_normalise(blend)
    q = quat_normalise(quats_in[i])
    v_q = v_quats_in[i]
    v_quat = quat_normalise_adjoint(quats_in[i], quat_multiply(quat_conjugate(b), v_q))
    v_blend = quat_normalise_adjoint(blend, quat_multiply(v_q, quat_conjugate(q)))
    v_mean = wp.vec3(0.0)
    lost = beyond(v_quat) + beyond(v_blend)
    for k in range(K):
        m = indices_in[i, k]
        r = quat_normalise(rotations_in[m])
        p = nodes_in[m]
        shape = quat_normalise(shape_rotations_in[m])
        moved = quat_rotate(r, x - p) + p + translations_in[m]
        v_w = wp.dot(v, moved) + wp.dot(v_blend, aligned(shape, reference))
        if has_extras != 0:
            v_w += wp.dot(v_extras_in[i], extras_in[m])
        v_weights_out[i, k] = v_w
        v_mean += weights_in[i, k] * quat_rotate(quat_conjugate(r), v)
        if not near(moved):
            lost += 1
        lost += beyond(v_w)
    lost += beyond(v_mean)
    if lost > 0 and beyond(v) + beyond(v_q) == 0:  # an incoming NaN stays NaN
        v_mean = wp.vec3(0.0)
        v_quat = wp.vec4(0.0)
        v_blend = wp.vec4(wp.nan)
        for k in range(K):
            v_weights_out[i, k] = 0.0
    v_means_out[i] = v_mean
    v_quats_out[i] = v_quat
    v_blends_out[i] = v_blend


@wp.func
def _add(
    i: int,
    k: int,
    row: int,
    means: wp.array[wp.vec3],
    nodes: wp.array[wp.vec3],
    shapes: wp.array[wp.vec4],
    indices: wp.array2d[wp.int32],
    weights: wp.array2d[float],
    v_means: wp.array[wp.vec3],
    v_blends: wp.array[wp.vec4],
    v_extras: wp.array[wp.vec3],
    has_extras: int,
    sums: wp.array2d[float],
):
    """Add the pair of Gaussian i and its k-th neighbour to that node's sums."""
    if not finite(v_blends[i]):
        return
    m = indices[i, k]
    w = weights[i, k]
    v = w * v_means[i]
    arm = means[i] - nodes[m]
    for a in range(3):
        for c in range(3):
            sums[row, 3 * a + c] = sums[row, 3 * a + c] + v[a] * arm[c]
        sums[row, 9 + a] = sums[row, 9 + a] + v[a]
    if wp.dot(quat_normalise(shapes[m]), quat_normalise(shapes[indices[i, 0]])) < 0.0:
        w = -w
    v_blend = v_blends[i]
    for a in range(4):
        sums[row, 12 + a] = sums[row, 12 + a] + w * v_blend[a]
    if has_extras != 0:
        v_extra = weights[i, k] * v_extras[i]
        for a in range(3):
            sums[row, 16 + a] = sums[row, 16 + a] + v_extra[a]


@wp.kernel
def skin_reduce_chunks(
    first: int,
    # In:
    size: int,  # Gaussians a chunk
    means_in: wp.array[wp.vec3],  # [N]
    nodes_in: wp.array[wp.vec3],  # [M]
    shape_rotations_in: wp.array[wp.vec4],  # [M]
    indices_in: wp.array2d[wp.int32],  # [N, K]
    weights_in: wp.array2d[float],  # [N, K]
    v_means_in: wp.array[wp.vec3],  # [N]
    v_blends_in: wp.array[wp.vec4],  # [N]
    v_extras_in: wp.array[wp.vec3],  # [N], touched only with has_extras
    has_extras: int,
    # Out:
    sums_out: wp.array2d[float],  # [chunks * M, SUMS (+ 3)] zero on entry
):
    """Sum one chunk of Gaussians for every node, on a CPU. Chunk sizes do not depend on the number of threads."""
    chunk = first + wp.tid()
    M = nodes_in.shape[0]
    for i in range(chunk * size, wp.min((chunk + 1) * size, means_in.shape[0])):
        for k in range(indices_in.shape[1]):
            row = chunk * M + indices_in[i, k]
            _add(
                i, k, row, means_in, nodes_in, shape_rotations_in, indices_in, weights_in,
                v_means_in, v_blends_in, v_extras_in, has_extras, sums_out,
            )  # fmt: skip


@wp.kernel
def skin_finish(
    first: int,
    # In:
    chunks: int,
    rotations_in: wp.array[wp.vec4],  # [M]
    shape_rotations_in: wp.array[wp.vec4],  # [M]
    has_shape_rotations: int,
    has_extras: int,
    sums_in: wp.array2d[float],  # [chunks * M, SUMS (+ 3)]
    # Out:
    v_nodes_out: wp.array[wp.vec3],  # [M]
    v_translations_out: wp.array[wp.vec3],  # [M]
    v_rotations_out: wp.array[wp.vec4],  # [M]
    v_shape_rotations_out: wp.array[wp.vec4],  # [M], touched only with has_shape_rotations
    v_extras_out: wp.array[wp.vec3],  # [M], touched only with has_extras
):
    """Compute the gradients of one node from its sums."""
    m = first + wp.tid()
    M = rotations_in.shape[0]
    G = wp.mat33(0.0)
    v = wp.vec3(0.0)
    v_blend = wp.vec4(0.0)
    v_extras = wp.vec3(0.0)
    for chunk in range(chunks):
        row = chunk * M + m
        for a in range(3):
            for c in range(3):
                G[a, c] = G[a, c] + sums_in[row, 3 * a + c]
            v[a] = v[a] + sums_in[row, 9 + a]
        for a in range(4):
            v_blend[a] = v_blend[a] + sums_in[row, 12 + a]
        if has_extras != 0:
            for a in range(3):
                v_extras[a] = v_extras[a] + sums_in[row, 16 + a]
    r = quat_normalise(rotations_in[m])
    v_translations_out[m] = passed(v)
    v_nodes_out[m] = passed(v - quat_rotate(quat_conjugate(r), v))
    v_r = quat_matrix_adjoint(r, G)
    if has_shape_rotations != 0:
        v_shape_rotations_out[m] = passed(quat_normalise_adjoint(shape_rotations_in[m], v_blend))
    else:
        v_r += v_blend
    v_rotations_out[m] = passed(quat_normalise_adjoint(rotations_in[m], v_r))
    if has_extras != 0:
        v_extras_out[m] = passed(v_extras)
