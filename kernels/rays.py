"""Rays and frustum of a pinhole camera, shared by the kernels that cast rays at triangle meshes."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def eye_of(camera_in: wp.array2d[float]):
    """Return the position of a camera [3, 4] (camera-to-world, OpenCV)."""
    return wp.vec3(camera_in[0, 3], camera_in[1, 3], camera_in[2, 3])


@wp.func
def ray_through(camera_in: wp.array2d[float], K_in: wp.array2d[float], x: float, y: float):
    """Return the unit direction through an image point in pixels; pixel centres lie at +0.5."""
    right = wp.vec3(camera_in[0, 0], camera_in[1, 0], camera_in[2, 0])
    down = wp.vec3(camera_in[0, 1], camera_in[1, 1], camera_in[2, 1])
    forward = wp.vec3(camera_in[0, 2], camera_in[1, 2], camera_in[2, 2])
    u = (x - K_in[0, 2]) / K_in[0, 0]
    v = (y - K_in[1, 2]) / K_in[1, 1]
    return wp.normalize(right * u + down * v + forward)


@wp.func
def rotation_of(viewmat_in: wp.array2d[float]):
    """Return the rotation of a world-to-camera matrix [4, 4]."""
    return wp.matrix_from_rows(
        wp.vec3(viewmat_in[0, 0], viewmat_in[0, 1], viewmat_in[0, 2]),
        wp.vec3(viewmat_in[1, 0], viewmat_in[1, 1], viewmat_in[1, 2]),
        wp.vec3(viewmat_in[2, 0], viewmat_in[2, 1], viewmat_in[2, 2]),
    )


@wp.func
def in_view(viewmat_in: wp.array2d[float], K_in: wp.array2d[float], width: int, height: int, point: wp.vec3):
    """Return whether a point is in front of the camera and inside its image."""
    translation = wp.vec3(viewmat_in[0, 3], viewmat_in[1, 3], viewmat_in[2, 3])
    q = rotation_of(viewmat_in) * point + translation
    if q[2] <= 0.0:
        return False
    x = K_in[0, 0] * q[0] / q[2] + K_in[0, 2]
    y = K_in[1, 1] * q[1] / q[2] + K_in[1, 2]
    return x >= 0.0 and y >= 0.0 and x < float(width) and y < float(height)


@wp.func
def eye_of_view(viewmat_in: wp.array2d[float]):
    """Return the camera position of a world-to-camera matrix [4, 4]."""
    translation = wp.vec3(viewmat_in[0, 3], viewmat_in[1, 3], viewmat_in[2, 3])
    return -(wp.transpose(rotation_of(viewmat_in)) * translation)
