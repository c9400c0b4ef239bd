"""Palette for ``cpu/skinning.py``: two rows of sixteen floats per control point (node), each row one register.

- ``motion``: the affine map ``[R | p + T - R p]`` (12, row by row), then the unit shape rotation (4);
- ``reach``: position (3), ``-1 / (2 radius^2)``, ``log strength``, extras (3), hyper-coordinates (MAX_HYPER,
  zero-padded).

p is the node's rest position, T its translation and R its rotation; radius and strength give the RBF weight.
"""

import warp as wp

from ..gradient_limits import passed
from ..neighbors import MIN_STRENGTH
from ..quaternion import quat_matrix, quat_matrix_adjoint, quat_normalise, quat_normalise_adjoint
from ..types import MAX_HYPER as MAX_HYPER

wp.set_module_options({"enable_backward": False})

ROW = 16
row = wp.types.vector(length=16, dtype=float)


@wp.kernel
def palette(
    first: int,
    # In:
    nodes_in: wp.array[wp.vec3],  # [M]
    hyper_in: wp.array2d[float],  # [M, H], touched only with has_hyper
    has_hyper: int,
    radii_in: wp.array[float],  # [M], touched only with has_radii
    has_radii: int,
    strengths_in: wp.array[float],  # [M], touched only with has_strengths
    has_strengths: int,
    translations_in: wp.array[wp.vec3],  # [M]
    rotations_in: wp.array[wp.vec4],  # [M]
    shape_rotations_in: wp.array[wp.vec4],  # [M]
    extras_in: wp.array[wp.vec3],  # [M], touched only with has_extras
    has_extras: int,
    # Out:
    motion_out: wp.array2d[float],  # [M, 16]
    reach_out: wp.array2d[float],  # [M, 16]
):
    """Write the two rows of one node."""
    m = first + wp.tid()
    p = nodes_in[m]
    R = quat_matrix(quat_normalise(rotations_in[m]))
    t = (p - R * p) + translations_in[m]
    shape = quat_normalise(shape_rotations_in[m])
    for a in range(3):
        for c in range(3):
            motion_out[m, 4 * a + c] = R[a, c]
        motion_out[m, 4 * a + 3] = t[a]
    for a in range(4):
        motion_out[m, 12 + a] = shape[a]
    for d in range(16):
        reach_out[m, d] = 0.0
    for d in range(3):
        reach_out[m, d] = p[d]
        if has_extras != 0:
            reach_out[m, 5 + d] = extras_in[m][d]
    if has_radii != 0:
        reach_out[m, 3] = -0.5 / (radii_in[m] * radii_in[m])
    if has_strengths != 0:
        reach_out[m, 4] = wp.log(wp.max(strengths_in[m], MIN_STRENGTH))
    if has_hyper != 0:
        for d in range(hyper_in.shape[1]):
            reach_out[m, 8 + d] = hyper_in[m, d]


@wp.func
def _sum_rows(m: int, parts: wp.array2d[row]):  # type: ignore[valid-type]
    """Return the sum of row m over all chunks, in order."""
    total = row()
    for chunk in range(parts.shape[0]):
        total += parts[chunk, m]
    return total


@wp.kernel
def palette_adjoint(
    first: int,
    # In:
    nodes_in: wp.array[wp.vec3],  # [M]
    has_hyper: int,
    radii_in: wp.array[float],  # [M]
    strengths_in: wp.array[float],  # [M], touched only with has_strengths
    has_strengths: int,
    rotations_in: wp.array[wp.vec4],  # [M]
    shape_rotations_in: wp.array[wp.vec4],  # [M]
    has_shape_rotations: int,
    has_extras: int,
    v_motion_in: wp.array2d[row],  # [chunks, M] rows
    v_reach_in: wp.array2d[row],  # [chunks, M] rows
    # Out:
    v_nodes_out: wp.array[wp.vec3],  # [M]
    v_hyper_out: wp.array2d[float],  # [M, H], touched only with has_hyper
    v_radii_out: wp.array[float],  # [M]
    v_strengths_out: wp.array[float],  # [M], touched only with has_strengths
    v_translations_out: wp.array[wp.vec3],  # [M]
    v_rotations_out: wp.array[wp.vec4],  # [M]
    v_shape_rotations_out: wp.array[wp.vec4],  # [M], touched only with has_shape_rotations
    v_extras_out: wp.array[wp.vec3],  # [M], touched only with has_extras
):
    """Compute the gradients of one node from the gradients of its two rows."""
    m = first + wp.tid()
    motion = _sum_rows(m, v_motion_in)
    reach = _sum_rows(m, v_reach_in)
    p = nodes_in[m]
    r = quat_normalise(rotations_in[m])
    v_t = wp.vec3(motion[3], motion[7], motion[11])
    G = wp.mat33(
        motion[0], motion[1], motion[2], motion[4], motion[5], motion[6], motion[8], motion[9], motion[10]
    )  # fmt: skip
    v_r = quat_matrix_adjoint(r, G - wp.outer(v_t, p))
    v_shape = wp.vec4(motion[12], motion[13], motion[14], motion[15])
    if has_shape_rotations != 0:
        v_shape_rotations_out[m] = passed(quat_normalise_adjoint(shape_rotations_in[m], v_shape))
    else:
        v_r += v_shape
    v_rotations_out[m] = passed(quat_normalise_adjoint(rotations_in[m], v_r))
    v_translations_out[m] = passed(v_t)
    inverse = 1.0 / (radii_in[m] * radii_in[m])
    v_p = v_t - wp.transpose(quat_matrix(r)) * v_t
    v_radius = float(0.0)
    if reach[3] != 0.0:
        v_radius = reach[3] * inverse / radii_in[m]
    for d in range(3):
        if reach[d] != 0.0:
            v_p[d] = v_p[d] + reach[d] * inverse
    v_nodes_out[m] = passed(v_p)
    v_radii_out[m] = passed(v_radius)
    if has_hyper != 0:
        for d in range(v_hyper_out.shape[1]):
            v_h = float(0.0)
            if reach[8 + d] != 0.0:
                v_h = reach[8 + d] * inverse
            v_hyper_out[m, d] = passed(v_h)
    if has_strengths != 0:
        v_strength = float(0.0)
        if strengths_in[m] > MIN_STRENGTH:
            v_strength = reach[4] / strengths_in[m]
        v_strengths_out[m] = passed(v_strength)
    if has_extras != 0:
        v_extras_out[m] = passed(wp.vec3(reach[5], reach[6], reach[7]))
