"""Rays of a pinhole camera, and what it sees of a point: shared by the kernels that look at triangle meshes."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def eye_of(camera_in: wp.array2d[float]):
    """Where a camera [3, 4] (camera-to-world, OpenCV) stands."""
    return wp.vec3(camera_in[0, 3], camera_in[1, 3], camera_in[2, 3])


@wp.func
def ray_through(camera_in: wp.array2d[float], K_in: wp.array2d[float], x: float, y: float):
    """Unit direction through an image point, pixels; pixel centres lie at halves."""
    right = wp.vec3(camera_in[0, 0], camera_in[1, 0], camera_in[2, 0])
    down = wp.vec3(camera_in[0, 1], camera_in[1, 1], camera_in[2, 1])
    forward = wp.vec3(camera_in[0, 2], camera_in[1, 2], camera_in[2, 2])
    u = (x - K_in[0, 2]) / K_in[0, 0]
    v = (y - K_in[1, 2]) / K_in[1, 1]
    return wp.normalize(right * u + down * v + forward)


@wp.func
def rotation_of(viewmat_in: wp.array2d[float]):
    """Of a world-to-camera matrix [4, 4]."""
    return wp.matrix_from_rows(
        wp.vec3(viewmat_in[0, 0], viewmat_in[0, 1], viewmat_in[0, 2]),
        wp.vec3(viewmat_in[1, 0], viewmat_in[1, 1], viewmat_in[1, 2]),
        wp.vec3(viewmat_in[2, 0], viewmat_in[2, 1], viewmat_in[2, 2]),
    )


@wp.func
def in_view(viewmat_in: wp.array2d[float], K_in: wp.array2d[float], width: int, height: int, point: wp.vec3):
    """Whether a point is in front of the camera and inside its image."""
    translation = wp.vec3(viewmat_in[0, 3], viewmat_in[1, 3], viewmat_in[2, 3])
    q = rotation_of(viewmat_in) * point + translation
    if q[2] <= 0.0:
        return False
    x = K_in[0, 0] * q[0] / q[2] + K_in[0, 2]
    y = K_in[1, 1] * q[1] / q[2] + K_in[1, 2]
    return x >= 0.0 and y >= 0.0 and x < float(width) and y < float(height)


@wp.func
def eye_of_view(viewmat_in: wp.array2d[float]):
    """Where the camera of a world-to-camera matrix stands."""
    translation = wp.vec3(viewmat_in[0, 3], viewmat_in[1, 3], viewmat_in[2, 3])
    return -(wp.transpose(rotation_of(viewmat_in)) * translation)
