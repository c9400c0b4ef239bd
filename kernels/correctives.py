"""Pose-dependent correctives: each Gaussian's displacement as a function of its own rotation.

Linear blend skinning moves a Gaussian rigidly with its control points, so that skin and cloth near a joint sink in or
bulge out. Like the pose blend shapes of body models, a corrective is linear in the rotation: if a surface turns by R,
its mean moves by ``0.1 R C vec(R - I)``, where C is a 3 x 9 matrix in the frame at rest and vec stacks rows.

An edit turns surfaces further than the training motion did, where C is not known. The rotation that determines the
displacement is therefore an input of its own: under an edit it is the motion's, and the edit only carries the
displacement along.
"""

import warp as wp

from .quaternion import rotation_between

wp.set_module_options({"enable_backward": False})

SCALE = wp.constant(0.1)
"""Scale of the displacement, chosen so that C learns about as fast as the means."""


@wp.func
def corrected(
    i: int, mean: wp.vec3, correctives: wp.array2d[float], quat: wp.vec4, quat_t: wp.vec4, quat_own: wp.vec4
) -> wp.vec3:
    """Return the skinned mean of Gaussian i with its corrective; a non-finite one is left out."""
    turn = rotation_between(quat, quat_own) - wp.identity(n=3, dtype=float)
    shift = wp.vec3(0.0, 0.0, 0.0)
    for a in range(3):
        for r in range(3):
            for c in range(3):
                shift[a] = shift[a] + correctives[i, 9 * a + 3 * r + c] * turn[r, c]
    moved = mean + SCALE * (rotation_between(quat, quat_t) * shift)
    if not wp.isfinite(wp.dot(moved - mean, wp.vec3(1.0, 1.0, 1.0))):
        moved = mean
    return moved


@wp.kernel
def correct(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N] skinned
    correctives_in: wp.array2d[float],  # [N, 27] C by rows
    quats_in: wp.array[wp.vec4],  # [N] at rest, any norm
    quats_t_in: wp.array[wp.vec4],  # [N] posed, any norm
    quats_own_in: wp.array[wp.vec4],  # [N] that determine the displacement, any norm
    # Out:
    means_out: wp.array[wp.vec3],  # [N]
):
    """Add the corrective to a mean. Grid: N."""
    i = first + wp.tid()
    means_out[i] = corrected(i, means_in[i], correctives_in, quats_in[i], quats_t_in[i], quats_own_in[i])


@wp.kernel
def correct_adjoint(
    first: int,
    # In:
    correctives_in: wp.array2d[float],  # [N, 27]
    quats_in: wp.array[wp.vec4],  # [N]
    quats_t_in: wp.array[wp.vec4],  # [N]
    quats_own_in: wp.array[wp.vec4],  # [N]
    v_means_t_in: wp.array[wp.vec3],  # [N]
    # Out:
    v_correctives_out: wp.array2d[float],  # [N, 27]
):
    """Compute the gradient of C; a non-finite displacement passes none. Grid: N."""
    i = first + wp.tid()
    turn = rotation_between(quats_in[i], quats_own_in[i]) - wp.identity(n=3, dtype=float)
    v_shift = SCALE * (wp.transpose(rotation_between(quats_in[i], quats_t_in[i])) * v_means_t_in[i])
    total = float(0.0)
    for a in range(3):
        for r in range(3):
            for c in range(3):
                total += correctives_in[i, 9 * a + 3 * r + c] * turn[r, c] + v_shift[a] * turn[r, c]
    valid = wp.isfinite(total)
    for a in range(3):
        for r in range(3):
            for c in range(3):
                v_correctives_out[i, 9 * a + 3 * r + c] = wp.where(valid, v_shift[a] * turn[r, c], 0.0)
