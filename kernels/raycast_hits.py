"""First hits of a camera's rays on a triangle mesh: what a synthetic picture shows, for true depth, flow and masks."""

import warp as wp

from .rays import eye_of, ray_through

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(100.0)
NOTHING = wp.constant(-1)
"""Face of a pixel whose ray hits nothing."""


@wp.kernel
def first_hits(
    first: int,
    # In:
    mesh: wp.uint64,
    camera_in: wp.array2d[float],  # [3, 4] camera-to-world, OpenCV
    K_in: wp.array2d[float],  # [3, 3]
    columns: int,  # width of the image
    # Out:
    face_out: wp.array2d[wp.int32],  # [H, W] index of the triangle, or NOTHING
    shares_out: wp.array2d[wp.vec3],  # [H, W] barycentric coordinates of the hit
    depth_out: wp.array2d[float],  # [H, W] along the optical axis, 0 where nothing is hit
):
    """Cast a ray through the centre of one pixel. Grid: H x W."""
    i = first + wp.tid()
    y = i // columns
    x = i % columns
    direction = ray_through(camera_in, K_in, float(x) + 0.5, float(y) + 0.5)
    query = wp.mesh_query_ray(mesh, eye_of(camera_in), direction, FAR)
    face = int(NOTHING)
    shares = wp.vec3(0.0, 0.0, 0.0)
    depth = float(0.0)
    if query.result:
        face = query.face
        shares = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)
        forward = wp.vec3(camera_in[0, 2], camera_in[1, 2], camera_in[2, 2])
        depth = query.t * wp.dot(direction, forward)
    face_out[y, x] = face
    shares_out[y, x] = shares
    depth_out[y, x] = depth
