"""As-rigid-as-possible editing of the control points: the two kernels that run before each sparse solve.

Both compute in float64: there are only a few hundred points, and results are compared bit by bit. Edges are stored in
compressed rows (``begin``), and each edge is listed in both directions.
"""

import warp as wp

from .arap import largest_entry

wp.set_module_options({"enable_backward": False})


@wp.kernel
def turn_nodes(
    first: int,
    # In:
    nodes_in: wp.array[wp.int32],  # [F] nodes with an unknown rotation
    rest_in: wp.array[wp.vec3d],  # [M]
    posed_in: wp.array[wp.vec3d],  # [M]
    begin_in: wp.array[wp.int32],  # [M + 1]
    neighbors_in: wp.array[wp.int32],  # [E]
    weights_in: wp.array[wp.float64],  # [E]
    smoothness: wp.float64,  # weight of a neighbour's rotation, squared units of the positions
    rotations_in: wp.array[wp.mat33d],  # [M] of the step before
    leaning_in: wp.array[wp.float64],  # [M] weight of a requested rotation, squared units of the positions
    asked_in: wp.array[wp.mat33d],  # [M] requested rotations, read where that weight is not 0
    # Out:
    rotations_out: wp.array[wp.mat33d],  # [M], rows of nodes_in only
):
    """Compute the rotation R of each node in ``nodes_in`` (SR-ARAP, Levi & Gotsman). Grid: F.

    R minimises ``sum w (|e' - R e|^2 + smoothness |R - R_j|^2) + leaning |R - asked|^2`` over the node's edges. e is an
    edge at rest and e' the posed one, R_j is the rotation of the neighbour, and ``asked`` is the requested rotation.

    If all edges are parallel, many rotations fit equally well; the smallest is taken.
    """
    i = nodes_in[first + wp.tid()]
    S = wp.mat33d(wp.float64(0.0))
    for at in range(begin_in[i], begin_in[i + 1]):
        j = neighbors_in[at]
        edge = rest_in[j] - rest_in[i]
        posed = posed_in[j] - posed_in[i]
        S += weights_in[at] * (wp.outer(posed, edge) + smoothness * rotations_in[j])
    if leaning_in[i] > wp.float64(0.0):
        S += leaning_in[i] * asked_in[i]
    largest = largest_entry(S)
    R = rotations_in[i]
    if largest > wp.float64(1.0e-60):
        U, sigma, V = wp.svd3(S / largest)
        # A reflection is undone along the smallest singular value, which comes last.
        if wp.determinant(U) * wp.determinant(V) < wp.float64(0.0):
            for a in range(3):
                U[a, 2] = -U[a, 2]
        if sigma[1] > wp.float64(1.0e-12) * sigma[0]:
            R = U * wp.transpose(V)
        else:
            before = wp.vec3d(V[0, 0], V[1, 0], V[2, 0])
            after = wp.vec3d(U[0, 0], U[1, 0], U[2, 0])
            axis = wp.cross(before, after)
            cosine = wp.dot(before, after)
            if cosine > wp.float64(-0.999999):
                K = wp.skew(axis)
                R = wp.identity(n=3, dtype=wp.float64) + K + K * K / (wp.float64(1.0) + cosine)
    rotations_out[i] = R


@wp.kernel
def edge_sums(
    first: int,
    # In:
    nodes_in: wp.array[wp.int32],  # [F] nodes with an unknown position
    fixed_in: wp.array[wp.int32],  # [M] 1: position known
    rest_in: wp.array[wp.vec3d],  # [M]
    posed_in: wp.array[wp.vec3d],  # [M]
    begin_in: wp.array[wp.int32],  # [M + 1]
    neighbors_in: wp.array[wp.int32],  # [E]
    weights_in: wp.array[wp.float64],  # [E]
    stretch: wp.float64,  # weight of keeping an edge's length, relative to that of keeping its shape
    limit: wp.float64,  # weight of keeping an edge's length between two multiples of that at rest, likewise
    shortest: wp.float64,  # the smaller multiple
    longest: wp.float64,  # the larger one
    rotations_in: wp.array[wp.mat33d],  # [M]
    pulls_in: wp.array[wp.float64],  # [M] weight of a soft target
    targets_in: wp.array[wp.vec3d],  # [M]
    # Out:
    sums_out: wp.array[wp.vec3d],  # [F]
):
    """Compute the right-hand side of the linear system: rotated edges, known neighbours and soft targets. Grid: F.

    The limit on lengths counts half its weight in the matrix, with the present edge as the other half of its target:
    with its whole weight, iterations converge more slowly; with less than half, they may diverge.
    """
    at_row = first + wp.tid()
    i = nodes_in[at_row]
    total = pulls_in[i] * targets_in[i]
    for at in range(begin_in[i], begin_in[i + 1]):
        j = neighbors_in[at]
        edge = rest_in[i] - rest_in[j]
        wanted = wp.float64(0.5) * ((rotations_in[i] + rotations_in[j]) * edge)
        posed = posed_in[i] - posed_in[j]
        kept = wanted  # the edge at its old length
        allowed = wanted  # the edge at the nearest length that the limit allows
        size = wp.length(posed)
        if size > wp.float64(0.0):
            # The weight says how well the edge's direction fits; otherwise reversed edges and folds would persist.
            cosine = wp.dot(posed, wanted) / wp.max(size * wp.length(wanted), wp.float64(1e-300))
            along = wp.max(cosine, wp.float64(0.0))
            old = wp.length(edge)
            near = wp.clamp(size, shortest * old, longest * old)
            kept = (along * old / size) * posed + (wp.float64(1.0) - along) * wanted
            allowed = (along * near / size) * posed + (wp.float64(1.0) - along) * wanted
        wanted += stretch * kept
        wanted += limit * (allowed - wp.float64(0.5) * posed)
        total += (weights_in[at] / (wp.float64(1.0) + stretch + wp.float64(0.5) * limit)) * wanted
        if fixed_in[j] != 0:
            total += weights_in[at] * posed_in[j]
    sums_out[at_row] = total
