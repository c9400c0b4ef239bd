"""Sums over the pairs of every control point on CUDA, where a node may have hundreds or thousands of pairs.

The list of pairs, sorted by node, is cut into segments of equal length, one per thread. Where the node changes within a
segment, the thread stores its sums and starts new ones. The sums of segment s for node m go to row ``s + m``. From one
stored sum to the next, s or m grows and neither shrinks, so no row is used twice, and ``segments + nodes`` rows suffice
for any list. A second pass adds up each node's rows in order, so results are reproducible bit by bit.
"""

from __future__ import annotations

import warp as wp

from ..quaternion import quat_normalise
from ..skinning import finite

wp.set_module_options({"enable_backward": False})

SEGMENT = 32
"""Number of pairs per thread: small enough to fill a GPU at 40,000 Gaussians, large enough for a short second pass."""
LANES = 8
"""Number of coordinates of a point that one thread sums."""

Lane = wp.types.vector(length=LANES, dtype=wp.float32)


@wp.func
def put_skin_row(
    row: int, G: wp.mat33, v: wp.vec3, blend: wp.vec4, extra: wp.vec3, has_extras: int, rows: wp.array2d[float]
):
    for a in range(3):
        for c in range(3):
            rows[row, 3 * a + c] = G[a, c]
        rows[row, 9 + a] = v[a]
    for a in range(4):
        rows[row, 12 + a] = blend[a]
    if has_extras != 0:
        for a in range(3):
            rows[row, 16 + a] = extra[a]


@wp.kernel
def skin_segments(
    first: int,
    # In:
    order_in: wp.array[wp.int32],  # [N * K] pairs i * K + k sorted by node
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
    rows_out: wp.array2d[float],  # [segments + M, SUMS (+ 3)] columns as in skinning.skin_finish
):
    segment = first + wp.tid()
    K = indices_in.shape[1]
    node = int(-1)
    G = wp.mat33(0.0)
    v_sum = wp.vec3(0.0)
    blend = wp.vec4(0.0)
    extra = wp.vec3(0.0)
    for at in range(segment * SEGMENT, wp.min((segment + 1) * SEGMENT, order_in.shape[0])):
        pair = order_in[at]
        i = pair // K
        k = pair - i * K
        m = indices_in[i, k]
        if m != node:
            if node >= 0:
                put_skin_row(segment + node, G, v_sum, blend, extra, has_extras, rows_out)
            node = m
            G = wp.mat33(0.0)
            v_sum = wp.vec3(0.0)
            blend = wp.vec4(0.0)
            extra = wp.vec3(0.0)
        if finite(v_blends_in[i]):
            w = weights_in[i, k]
            v = w * v_means_in[i]
            G += wp.outer(v, means_in[i] - nodes_in[m])
            v_sum += v
            if has_extras != 0:
                extra += w * v_extras_in[i]
            own = quat_normalise(shape_rotations_in[m])
            if wp.dot(own, quat_normalise(shape_rotations_in[indices_in[i, 0]])) < 0.0:
                w = -w
            blend += w * v_blends_in[i]
    if node >= 0:
        put_skin_row(segment + node, G, v_sum, blend, extra, has_extras, rows_out)


@wp.func
def put_rbf_row(row: int, part: int, dimensions: int, v: float, v_d2: float, v_x: Lane, rows: wp.array2d[float]):
    if part == 0:
        rows[row, 0] = v
        rows[row, 1] = v_d2
    for d in range(8):
        if part * LANES + d < dimensions:
            rows[row, 2 + part * LANES + d] = v_x[d]


@wp.kernel
def rbf_segments(
    first: int,
    # In:
    parts: int,  # threads a segment, LANES coordinates each
    order_in: wp.array[wp.int32],  # [N * K] pairs i * K + k sorted by node
    points_in: wp.array2d[float],  # [N, D]
    nodes_in: wp.array2d[float],  # [M, D]
    indices_in: wp.array2d[wp.int32],  # [N, K]
    v_logits_in: wp.array2d[float],  # [N, K]
    # Out:
    rows_out: wp.array2d[float],  # [segments + M, 2 + D] columns as in neighbors.rbf_finish: v, v d^2, v (x - p)
):
    """Sum one segment of pairs for the adjoint of the RBF weights. Grid: segments x parts."""
    t = first + wp.tid()
    segment = t // parts
    part = t - segment * parts
    K = indices_in.shape[1]
    D = points_in.shape[1]
    node = int(-1)
    v_sum = float(0.0)
    v_d2 = float(0.0)
    v_x = Lane()
    for at in range(segment * SEGMENT, wp.min((segment + 1) * SEGMENT, order_in.shape[0])):
        pair = order_in[at]
        i = pair // K
        k = pair - i * K
        m = indices_in[i, k]
        if m != node:
            if node >= 0:
                put_rbf_row(segment + node, part, D, v_sum, v_d2, v_x, rows_out)
            node = m
            v_sum = float(0.0)
            v_d2 = float(0.0)
            v_x = Lane()
        v = v_logits_in[i, k]
        if v != 0.0:
            d2 = float(0.0)
            for d in range(D):
                e = points_in[i, d] - nodes_in[m, d]
                d2 += e * e
            v_sum += v
            v_d2 += v * d2
            for d in range(8):
                if part * LANES + d < D:
                    v_x[d] = v_x[d] + v * (points_in[i, part * LANES + d] - nodes_in[m, part * LANES + d])
    if node >= 0:
        put_rbf_row(segment + node, part, D, v_sum, v_d2, v_x, rows_out)


@wp.kernel
def sum_segments(
    first: int,
    # In:
    begin_in: wp.array[wp.int32],  # [M + 1] a node's pairs lie at begin[m] .. begin[m + 1]
    rows_in: wp.array2d[float],  # [segments + M, W]
    # Out:
    sums_out: wp.array2d[float],  # [M, W]
):
    """Add up one column of a node's rows, in the order of the segments. Grid: M x W."""
    t = first + wp.tid()
    m = t // rows_in.shape[1]
    column = t - m * rows_in.shape[1]
    begin = begin_in[m]
    end = begin_in[m + 1]
    total = float(0.0)
    if begin < end:
        for segment in range(begin // SEGMENT, (end - 1) // SEGMENT + 1):
            total += rows_in[segment + m, column]
    sums_out[m, column] = total
