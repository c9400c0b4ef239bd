"""Inverse kinematics: turns of a chain of joints that take a point to a place, by Gauss-Newton steps.

Float64, and one thread for the whole chain: it has a few joints, and each step needs the one before.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
SMALL = wp.constant(wp.float64(1.0e-3))
"""Angle in radians below which series replace quotients."""


@wp.func
def turn_of(v: wp.vec3d) -> wp.quatd:
    """Return the rotation by ``|v|`` radians about v."""
    angle = wp.length(v)
    share = HALF - angle * angle / wp.float64(48.0)
    if angle > SMALL:
        share = wp.sin(HALF * angle) / angle
    return wp.quatd(share * v[0], share * v[1], share * v[2], wp.cos(HALF * angle))


@wp.func
def vector_of(q: wp.quatd) -> wp.vec3d:
    """Return the rotation vector of a unit quaternion, at most half a turn long."""
    v = wp.vec3d(q[0], q[1], q[2])
    w = q[3]
    if w < ZERO:
        v = -v
        w = -w
    sine = wp.length(v)
    share = wp.float64(2.0)
    if sine > wp.float64(1.0e-12):
        share = wp.float64(2.0) * wp.atan2(sine, w) / sine
    return share * v


@wp.func
def change_of_vector(v: wp.vec3d) -> wp.mat33d:
    """Return the derivative of a rotation vector by a small turn that follows the rotation."""
    angle = wp.length(v)
    K = wp.skew(v)
    factor = ONE / wp.float64(12.0)
    if angle > SMALL:
        factor = (ONE / angle - HALF / wp.tan(HALF * angle)) / angle
    return wp.identity(n=3, dtype=wp.float64) - HALF * K + factor * (K * K)


@wp.kernel
def reach_place(
    first: int,
    # In:
    joints_in: wp.array[wp.vec3d],  # [C] in the unturned pose
    shifts_in: wp.array[wp.vec3d],  # [C] present displacements of the joints
    rotations_in: wp.array[wp.mat33d],  # [C] present turns
    costs_in: wp.array[wp.mat33d],  # [C] quadratic forms of further turns
    base_in: wp.array[wp.mat33d],  # [1] rotation of what carries the first joint
    ends_in: wp.array[wp.vec3d],  # [2] displacement of what carries the first joint, and the grip in the unturned pose
    aims_in: wp.array[wp.vec3d],  # [S] places on the way, and the last one
    most_in: wp.array[wp.int32],  # [S] largest number of iterations for each
    pull: wp.float64,  # weight of the squared distance from the place
    slide: wp.float64,  # weight of the first joint's squared shift
    longest: wp.float64,  # largest turn of a joint in one iteration
    tolerance: wp.float64,  # turn in one iteration below which iterations stop
    # Scratch:
    frames: wp.array[wp.mat33d],  # [C]
    points: wp.array[wp.vec3d],  # [C]
    # Out:
    turns_out: wp.array[wp.quatd],  # [C] xyzw further turns, which follow the present ones
    shift_out: wp.array[wp.vec3d],  # [1] further shift of the first joint
):
    """Minimise the cost of further turns and of a shift, plus the pull to each place in turn. Grid: 1.

    The costs' matrix is block diagonal and the pull has rank 3, so that a step needs inverses of 3 x 3 matrices alone
    (Woodbury's identity). ``frames`` first holds the frame of each joint, then the change of its turn by a unit of
    force at the grip.
    """
    chain = joints_in.shape[0]
    base = base_in[0]
    for place in range(aims_in.shape[0]):
        going = int(1)
        for _ in range(most_in[place]):
            if going == 1:
                frame = base
                offset = ends_in[0]
                for k in range(chain):
                    joint = joints_in[k] + shifts_in[k]
                    if k == 0:
                        joint += shift_out[0]
                    local = wp.quat_to_matrix(turns_out[k]) * rotations_in[k]
                    frames[k] = frame
                    points[k] = frame * joint + offset
                    offset = points[k] - frame * (local * joints_in[k])
                    frame = frame * local
                end = frame * ends_in[1] + offset

                give = (ONE / pull + ONE / slide) * wp.identity(n=3, dtype=wp.float64)
                miss = base * shift_out[0] + aims_in[place] - end
                for k in range(chain):
                    J = wp.skew(points[k] - end) * frames[k]
                    vector = vector_of(turns_out[k])
                    inner = change_of_vector(vector)
                    frames[k] = wp.inverse(wp.transpose(inner) * costs_in[k] * inner) * wp.transpose(J)
                    give += J * frames[k]
                    miss += J * vector

                force = wp.inverse(give) * miss
                turned = ZERO
                for k in range(chain):
                    turned = wp.max(turned, wp.length(frames[k] * force - vector_of(turns_out[k])))
                share = wp.min(ONE, longest / wp.max(turned, wp.float64(1.0e-300)))
                shift_out[0] = shift_out[0] + share * (wp.transpose(base) * force / slide - shift_out[0])
                for k in range(chain):
                    change = share * (frames[k] * force - vector_of(turns_out[k]))
                    turns_out[k] = wp.normalize(turn_of(change) * turns_out[k])
                if share * turned < tolerance:
                    going = 0
