"""The K nearest control points ("nodes") of every Gaussian, and their skinning weights (SC-GS, Eq. 5).

``nearest`` is exact. Each thread visits all nodes in ascending order for one point and keeps a sorted list of the K
nearest so far. A node enters the list only if it is strictly nearer than one in it, so ties go to the lower index and
NaN distances are never inserted.
"""

import warp as wp

from .gradient_limits import passed

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

MAX_NEIGHBORS = 16
MIN_STRENGTH = wp.constant(1.0e-30)
"""Strength that smaller ones count as, so that the logarithm stays finite."""


@wp.kernel
def number_pairs(
    first: int,
    # In:
    nodes_in: wp.array[wp.int32],  # [P] node of each pair, in [-1, M)
    # Out:
    keys_out: wp.array[wp.int32],  # [2 P] the node + 1, in the first half
    order_out: wp.array[wp.int32],  # [2 P] the pair's index, in the first half
):
    """Write the key of a pair, which is not negative, so that a sort need not look at the sign."""
    i = first + wp.tid()
    keys_out[i] = nodes_in[i] + 1
    order_out[i] = i


@wp.kernel
def node_begins(
    first: int,
    # In:
    keys_in: wp.array[wp.int32],  # [2 P] of number_pairs, sorted in the first half
    # Out:
    begin_out: wp.array[wp.int32],  # [M + 1] index of the first pair whose node is m or more
):
    """Write the beginnings that lie between pair ``i - 1`` and pair ``i``. Grid: P + 1."""
    i = first + wp.tid()
    low = int(0)
    high = begin_out.shape[0]
    if i > 0:
        low = keys_in[i - 1]
    if i < keys_in.shape[0] // 2:
        high = keys_in[i]
    for m in range(low, high):
        begin_out[m] = i


@wp.kernel
def nearest(
    first: int,
    # In:
    points_in: wp.array2d[float],  # [N, D]
    nodes_in: wp.array2d[float],  # [M, D]
    K: int,
    # Out:
    indices_out: wp.array2d[wp.int32],  # [N, K] nearest first
    distances_out: wp.array2d[float],  # [N, K] squared
):
    """Find the K nearest nodes of point ``i``; row ``i`` of the outputs holds the sorted list during the search."""
    i = first + wp.tid()
    for j in range(K):
        indices_out[i, j] = j
        distances_out[i, j] = wp.inf
    worst = float(wp.inf)
    for m in range(nodes_in.shape[0]):
        d2 = float(0.0)
        for d in range(nodes_in.shape[1]):
            e = points_in[i, d] - nodes_in[m, d]
            d2 += e * e
        if d2 < worst:
            j = K - 1
            while j > 0 and d2 < distances_out[i, wp.max(j - 1, 0)]:
                distances_out[i, j] = distances_out[i, j - 1]
                indices_out[i, j] = indices_out[i, j - 1]
                j -= 1
            distances_out[i, j] = d2
            indices_out[i, j] = m
            worst = distances_out[i, K - 1]


@wp.func
def squared_distance(points: wp.array2d[float], i: int, nodes: wp.array2d[float], m: int):
    d2 = float(0.0)
    for d in range(nodes.shape[1]):
        e = points[i, d] - nodes[m, d]
        d2 += e * e
    return d2


@wp.kernel
def rbf_weights(
    first: int,
    # In:
    points_in: wp.array2d[float],  # [N, D]
    nodes_in: wp.array2d[float],  # [M, D]
    radii_in: wp.array[float],  # [M]
    strengths_in: wp.array[float],  # [M], touched only with has_strengths
    has_strengths: int,
    indices_in: wp.array2d[wp.int32],  # [N, K]
    # Out:
    weights_out: wp.array2d[float],  # [N, K]
):
    """Compute a Gaussian's weights: the softmax of ``log strength - distance^2 / (2 radius^2)`` over its neighbours.

    The first neighbour gets all the weight if no exponent is finite.
    """
    i = first + wp.tid()
    K = indices_in.shape[1]
    top = float(-wp.inf)
    for k in range(K):
        m = indices_in[i, k]
        r = radii_in[m]
        e = -squared_distance(points_in, i, nodes_in, m) / (2.0 * r * r)
        if has_strengths != 0:
            e += wp.log(wp.max(strengths_in[m], MIN_STRENGTH))
        weights_out[i, k] = e
        if wp.isfinite(e):
            top = wp.max(top, e)
    total = float(0.0)
    for k in range(K):
        e = weights_out[i, k]
        w = float(0.0)
        if wp.isfinite(e):
            w = wp.exp(e - top)
        elif top == -wp.inf and k == 0:
            w = 1.0
        weights_out[i, k] = w
        total += w
    for k in range(K):
        weights_out[i, k] = weights_out[i, k] / total


@wp.kernel
def rbf_weights_adjoint(
    first: int,
    # In:
    points_in: wp.array2d[float],  # [N, D]
    nodes_in: wp.array2d[float],  # [M, D]
    radii_in: wp.array[float],  # [M]
    indices_in: wp.array2d[wp.int32],  # [N, K]
    weights_in: wp.array2d[float],  # [N, K]
    v_weights_in: wp.array2d[float],  # [N, K]
    # Out:
    v_logits_out: wp.array2d[float],  # [N, K] gradient to log s - d^2 / (2 r^2)
    v_points_out: wp.array2d[float],  # [N, D]
):
    """Compute the gradients of one Gaussian's values; later kernels sum those of the nodes from ``v_logits_out``."""
    i = first + wp.tid()
    K = indices_in.shape[1]
    mean = float(0.0)
    for k in range(K):
        mean += weights_in[i, k] * v_weights_in[i, k]
    for d in range(nodes_in.shape[1]):
        v_points_out[i, d] = 0.0
    for k in range(K):
        v = weights_in[i, k] * (v_weights_in[i, k] - mean)
        v_logits_out[i, k] = v
        if v != 0.0:
            m = indices_in[i, k]
            r = radii_in[m]
            v = v / (r * r)
            for d in range(nodes_in.shape[1]):
                v_points_out[i, d] = v_points_out[i, d] - v * (points_in[i, d] - nodes_in[m, d])
    for d in range(nodes_in.shape[1]):
        v_points_out[i, d] = passed(v_points_out[i, d])


@wp.func
def _rbf_add(
    i: int,
    m: int,
    row: int,
    v: float,
    points: wp.array2d[float],
    nodes: wp.array2d[float],
    sums: wp.array2d[float],
):
    """Add the pair of Gaussian i and node m to the node's sums: v, v |x - p|^2 and v (x - p).

    v is the gradient of the pair's exponent, x the Gaussian's position, and p the node's.
    """
    if v != 0.0:
        d2 = float(0.0)
        for d in range(nodes.shape[1]):
            e = points[i, d] - nodes[m, d]
            d2 += e * e
            sums[row, 2 + d] = sums[row, 2 + d] + v * e
        sums[row, 0] = sums[row, 0] + v
        sums[row, 1] = sums[row, 1] + v * d2


@wp.kernel
def rbf_reduce_chunks(
    first: int,
    # In:
    size: int,  # Gaussians a chunk
    points_in: wp.array2d[float],  # [N, D]
    nodes_in: wp.array2d[float],  # [M, D]
    indices_in: wp.array2d[wp.int32],  # [N, K]
    v_logits_in: wp.array2d[float],  # [N, K]
    # Out:
    sums_out: wp.array2d[float],  # [chunks * M, 2 + D] zero on entry
):
    """Sum one chunk of Gaussians for every node, on a CPU. Chunk sizes do not depend on the number of threads."""
    chunk = first + wp.tid()
    M = nodes_in.shape[0]
    for i in range(chunk * size, wp.min((chunk + 1) * size, points_in.shape[0])):
        for k in range(indices_in.shape[1]):
            m = indices_in[i, k]
            _rbf_add(i, m, chunk * M + m, v_logits_in[i, k], points_in, nodes_in, sums_out)


@wp.kernel
def rbf_finish(
    first: int,
    # In:
    chunks: int,
    radii_in: wp.array[float],  # [M]
    strengths_in: wp.array[float],  # [M], touched only with has_strengths
    has_strengths: int,
    sums_in: wp.array2d[float],  # [chunks * M, 2 + D]
    # Out:
    v_nodes_out: wp.array2d[float],  # [M, D]
    v_radii_out: wp.array[float],  # [M]
    v_strengths_out: wp.array[float],  # [M], touched only with has_strengths
):
    """Compute the gradients of one node from its sums."""
    m = first + wp.tid()
    M = radii_in.shape[0]
    r = radii_in[m]
    v = float(0.0)
    v_d2 = float(0.0)
    for c in range(chunks):
        v += sums_in[c * M + m, 0]
        v_d2 += sums_in[c * M + m, 1]
    v_radius = float(0.0)
    if v_d2 != 0.0:
        v_radius = v_d2 / (r * r * r)
    v_radii_out[m] = passed(v_radius)
    for d in range(v_nodes_out.shape[1]):
        v_x = float(0.0)
        for c in range(chunks):
            v_x += sums_in[c * M + m, 2 + d]
        if v_x != 0.0:
            v_x = v_x / (r * r)
        v_nodes_out[m, d] = passed(v_x)
    if has_strengths != 0:
        s = strengths_in[m]
        v_strength = float(0.0)
        if s > MIN_STRENGTH:
            v_strength = v / s
        v_strengths_out[m] = passed(v_strength)
