"""As-rigid-as-possible energy: the best-fitting rotation of each node's neighbourhood, and the residual."""

import warp as wp

from .gradient_limits import beyond

wp.set_module_options({"enable_backward": False})


@wp.func
def largest_entry(S: wp.mat33d):
    """Return the largest absolute entry, or 0 if an entry is non-finite.

    The result 0 tells callers that the matrix determines no rotation.
    """
    largest = wp.float64(0.0)
    for a in range(3):
        for b in range(3):
            if not wp.isfinite(S[a, b]):
                return wp.float64(0.0)
            largest = wp.max(largest, wp.abs(S[a, b]))
    return largest


@wp.kernel
def local_rotations(
    first: int,
    # In:
    rest_in: wp.array[wp.vec3],  # [M]
    posed_in: wp.array[wp.vec3],  # [M]
    neighbors_in: wp.array2d[wp.int32],  # [M, J], < 0 where missing
    weights_in: wp.array2d[float],  # [M, J]
    # Out:
    rotations_out: wp.array[wp.mat33],  # [M]
):
    """Compute the rotation R of each node that minimises sum w |e' - R e|^2 over its edges. Grid: M.

    e is an edge at rest and e' the posed one. With the SVD ``U S V^T = sum w e' e^T``, R is
    ``U diag(1, 1, det(U V^T)) V^T``.

    The computation is in float64, because nodes have few edges and those in thin limbs are nearly collinear.
    """
    i = first + wp.tid()
    S = wp.mat33d(wp.float64(0.0))
    for j in range(neighbors_in.shape[1]):
        n = neighbors_in[i, j]
        if n >= 0:
            edge = wp.vec3d(rest_in[n]) - wp.vec3d(rest_in[i])
            posed = wp.vec3d(posed_in[n]) - wp.vec3d(posed_in[i])
            S += wp.float64(weights_in[i, j]) * wp.outer(posed, edge)
    largest = largest_entry(S)
    R = wp.identity(n=3, dtype=wp.float64)
    if largest > wp.float64(1.0e-60):
        U, _sigma, V = wp.svd3(S / largest)
        # A reflection is undone along the smallest singular value, which comes last.
        if wp.determinant(U) * wp.determinant(V) < wp.float64(0.0):
            for a in range(3):
                U[a, 2] = -U[a, 2]
        R = U * wp.transpose(V)
    rotations_out[i] = wp.mat33(R)


@wp.func
def residual(rest: wp.vec3, posed: wp.vec3, rest_n: wp.vec3, posed_n: wp.vec3, R: wp.mat33):
    return (posed_n - posed) - R * (rest_n - rest)


@wp.kernel
def arap_energy(
    first: int,
    # In:
    rest_in: wp.array[wp.vec3],  # [M]
    posed_in: wp.array[wp.vec3],  # [M]
    neighbors_in: wp.array2d[wp.int32],  # [M, J]
    weights_in: wp.array2d[float],  # [M, J]
    rotations_in: wp.array[wp.mat33],  # [M]
    # Out:
    energies_out: wp.array[float],  # [M]
):
    """Add up a node's weighted squared residuals. Grid: M."""
    i = first + wp.tid()
    energy = float(0.0)
    for j in range(neighbors_in.shape[1]):
        n = neighbors_in[i, j]
        if n >= 0:
            e = residual(rest_in[i], posed_in[i], rest_in[n], posed_in[n], rotations_in[i])
            energy += weights_in[i, j] * wp.dot(e, e)
    energies_out[i] = energy


@wp.kernel
def arap_energy_adjoint(
    first: int,
    # In:
    rest_in: wp.array[wp.vec3],  # [M]
    posed_in: wp.array[wp.vec3],  # [M]
    neighbors_in: wp.array2d[wp.int32],  # [M, J]
    weights_in: wp.array2d[float],  # [M, J]
    rotations_in: wp.array[wp.mat33],  # [M], held constant
    order_in: wp.array[wp.int32],  # edges i * J + j sorted by the node they lead to, missing ones first
    begin_in: wp.array[wp.int32],  # [M + 1]
    v_energies_in: wp.array[float],  # [M]
    # Out:
    v_rest_out: wp.array[wp.vec3],  # [M]
    v_posed_out: wp.array[wp.vec3],  # [M]
):
    """Sum a node's gradients over its outgoing edges, then over its incoming edges. Grid: M.

    Edges whose gradient overflows or is non-finite are left out.
    """
    m = first + wp.tid()
    J = neighbors_in.shape[1]
    v_rest = wp.vec3(0.0)
    v_posed = wp.vec3(0.0)
    for j in range(J):
        n = neighbors_in[m, j]
        if n >= 0:
            e = residual(rest_in[m], posed_in[m], rest_in[n], posed_in[n], rotations_in[m])
            v = 2.0 * v_energies_in[m] * weights_in[m, j] * e
            if beyond(v) == 0:
                v_posed -= v
                v_rest += wp.transpose(rotations_in[m]) * v
    for at in range(begin_in[m], begin_in[m + 1]):
        edge = order_in[at]
        i = edge // J
        e = residual(rest_in[i], posed_in[i], rest_in[m], posed_in[m], rotations_in[i])
        v = 2.0 * v_energies_in[i] * weights_in[i, edge - i * J] * e
        if beyond(v) == 0:
            v_posed += v
            v_rest -= wp.transpose(rotations_in[i]) * v
    v_rest_out[m] = v_rest
    v_posed_out[m] = v_posed
