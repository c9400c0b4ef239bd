"""Posing: the network's output to a pose, with its adjoint; and skinning, correctives, tints, shading and activations
of a Gaussian in one launch, without one.

A frame on a GPU is many small kernels, so its time is that of their number. Training runs the kernels of the parts,
which have adjoints; on a CPU, two of them: skinning, and what follows it (``cpu/finishing.py``).
"""

import warp as wp

from .correctives import corrected
from .quaternion import quat_multiply, quat_normalise, quat_normalise_adjoint
from .shading import shaded, tinted
from .skinning import skinned

wp.set_module_options({"enable_backward": False})

LOG_SCALES, TINTS = wp.constant(1), wp.constant(2)
"""What the extras of the control points change; 0: there are none."""


@wp.func
def from_identity(motion: wp.array2d[float], m: int, column: int) -> wp.vec4:
    """Return the identity plus four columns."""
    return wp.vec4(1.0 + motion[m, column], motion[m, column + 1], motion[m, column + 2], motion[m, column + 3])


@wp.func
def near_identity(motion: wp.array2d[float], m: int, column: int) -> wp.vec4:
    """Return the unit quaternion of the identity plus four columns."""
    return quat_normalise(from_identity(motion, m, column))


@wp.kernel
def unit_pose(
    first: int,
    # In:
    motion_in: wp.array2d[float],  # [M, C] the network's output
    translation: int,  # the column at which each part begins; -1: it is not there
    rotation: int,
    shape_rotation: int,
    extra: int,
    # Out:
    translations_out: wp.array[wp.vec3],  # [M]
    rotations_out: wp.array[wp.vec4],  # [M] unit
    shape_rotations_out: wp.array[wp.vec4],  # [M] unit, touched only with shape_rotation
    extras_out: wp.array[wp.vec3],  # [M], touched only with extra
):
    """Split a row of the network's output. Its quaternions are differences from the identity. Grid: M."""
    m = first + wp.tid()
    translations_out[m] = wp.vec3(
        motion_in[m, translation], motion_in[m, translation + 1], motion_in[m, translation + 2]
    )
    rotations_out[m] = near_identity(motion_in, m, rotation)
    if shape_rotation >= 0:
        shape_rotations_out[m] = near_identity(motion_in, m, shape_rotation)
    if extra >= 0:
        extras_out[m] = wp.vec3(motion_in[m, extra], motion_in[m, extra + 1], motion_in[m, extra + 2])


@wp.func
def write_quaternion_gradient(
    motion: wp.array2d[float], m: int, column: int, v_unit: wp.vec4, v_motion: wp.array2d[float]
):
    """Write the gradient of four columns from that of their unit quaternion."""
    v_raw = quat_normalise_adjoint(from_identity(motion, m, column), v_unit)
    for k in range(4):
        v_motion[m, column + k] = v_raw[k]


@wp.kernel
def unit_pose_adjoint(
    first: int,
    # In:
    motion_in: wp.array2d[float],  # [M, C] the network's output
    translation: int,  # the column at which each part begins; -1: it has no gradient
    rotation: int,
    shape_rotation: int,
    extra: int,
    v_translations_in: wp.array[wp.vec3],  # [M]; each of the four is touched only with its column
    v_rotations_in: wp.array[wp.vec4],  # [M]
    v_shape_rotations_in: wp.array[wp.vec4],  # [M]
    v_extras_in: wp.array[wp.vec3],  # [M]
    # Out:
    v_motion_out: wp.array2d[float],  # [M, C]
):
    """Compute the gradient of a row of the network's output. Grid: M."""
    m = first + wp.tid()
    for c in range(v_motion_out.shape[1]):
        v_motion_out[m, c] = 0.0
    if translation >= 0:
        for k in range(3):
            v_motion_out[m, translation + k] = v_translations_in[m][k]
    if rotation >= 0:
        write_quaternion_gradient(motion_in, m, rotation, v_rotations_in[m], v_motion_out)
    if shape_rotation >= 0:
        write_quaternion_gradient(motion_in, m, shape_rotation, v_shape_rotations_in[m], v_motion_out)
    if extra >= 0:
        for k in range(3):
            v_motion_out[m, extra + k] = v_extras_in[m][k]


@wp.kernel
def pose_gaussians(
    first: int,
    # In: Gaussians at rest
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N] wxyz, any norm
    log_scales_in: wp.array[wp.vec3],  # [N]
    opacity_logits_in: wp.array[float],  # [N]
    sh_dc_in: wp.array[wp.vec3],  # [N]
    correctives_in: wp.array2d[float],  # [N, 27] or [N, 0]
    shading_in: wp.array2d[float],  # [N, 10] or [N, 0]
    # In: control points, as for skinning
    nodes_in: wp.array[wp.vec3],  # [M]
    translations_in: wp.array[wp.vec3],  # [M]
    rotations_in: wp.array[wp.vec4],  # [M]
    shape_rotations_in: wp.array[wp.vec4],  # [M]
    extras_in: wp.array[wp.vec3],  # [M], touched only with extras
    extras: int,
    indices_in: wp.array2d[wp.int32],  # [N, K]
    weights_in: wp.array2d[float],  # [N, K]
    quats_own_in: wp.array[wp.vec4],  # [N] rotations that correctives and shading follow, touched only with has_own
    has_own: int,
    # Out:
    means_out: wp.array[wp.vec3],  # [N]
    quats_out: wp.array[wp.vec4],  # [N] unit
    scales_out: wp.array[wp.vec3],  # [N]
    opacities_out: wp.array[float],  # [N]
    sh_dc_out: wp.array[wp.vec3],  # [N]
):
    """Pose and activate one Gaussian. Grid: N."""
    i = first + wp.tid()
    mean, blend, extra = skinned(
        i,
        means_in[i],
        nodes_in,
        translations_in,
        rotations_in,
        shape_rotations_in,
        extras_in,
        extras,
        indices_in,
        weights_in,
    )
    rest = quats_in[i]
    quat = quat_multiply(quat_normalise(blend), quat_normalise(rest))
    own = quat
    if has_own != 0:
        own = quats_own_in[i]
    if correctives_in.shape[1] > 0:
        mean = corrected(i, mean, correctives_in, rest, quat, own)
    log_scale = log_scales_in[i]
    if extras == LOG_SCALES:
        log_scale += extra
    color = sh_dc_in[i]
    if extras == TINTS:
        color = tinted(color, extra)
    if shading_in.shape[1] > 0:
        color = shaded(i, color, shading_in, rest, own)
    means_out[i] = mean
    quats_out[i] = quat
    scales_out[i] = wp.vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))
    opacities_out[i] = 1.0 / (1.0 + wp.exp(-opacity_logits_in[i]))
    sh_dc_out[i] = color
