"""Fusion of depth images into a volume of signed distances (Curless and Levoy 1996), one voxel per grid index.

A voxel in front of the surface that a view sees is outside by the distance to it, measured along the ray and multiplied
by the cosine of the angle at which the ray meets the surface; a voxel behind it by more than the truncation is hidden,
and the view says nothing. A ray that meets no surface says that all voxels on it are outside, by their distance from
the outline: alpha masks carve the volume.
"""

from __future__ import annotations

import warp as wp

from .projection import view_rotation

wp.set_module_options({"enable_backward": False})


@wp.func
def unprojected(depth_in: wp.array2d[float], K: wp.mat33, x: int, y: int) -> wp.vec3:
    z = depth_in[y, x]
    return z * wp.vec3((float(x) + 0.5 - K[0, 2]) / K[0, 0], (float(y) + 0.5 - K[1, 2]) / K[1, 1], 1.0)


@wp.func
def difference(depth_in: wp.array2d[float], K: wp.mat33, x: int, y: int, dx: int, dy: int, jump: float) -> wp.vec3:
    """Return the difference of the surface points on either side of a pixel, or on one side of it where depth jumps."""
    height = depth_in.shape[0]
    width = depth_in.shape[1]
    z = depth_in[y, x]
    middle = unprojected(depth_in, K, x, y)
    ahead = wp.vec3(0.0)
    behind = wp.vec3(0.0)
    if x + dx < width and y + dy < height:
        if depth_in[y + dy, x + dx] > 0.0 and wp.abs(depth_in[y + dy, x + dx] - z) < jump:
            ahead = unprojected(depth_in, K, x + dx, y + dy) - middle
    if x - dx >= 0 and y - dy >= 0:
        if depth_in[y - dy, x - dx] > 0.0 and wp.abs(depth_in[y - dy, x - dx] - z) < jump:
            behind = middle - unprojected(depth_in, K, x - dx, y - dy)
    return ahead + behind


@wp.kernel
def cosines(
    first: int,
    # In:
    depth_in: wp.array2d[float],  # [H, W] camera z; 0: no surface
    K_in: wp.array[wp.mat33],  # [1]
    jump: float,  # difference of depth between neighbouring pixels from which they show two surfaces
    # Out:
    cosine_out: wp.array2d[float],  # [H, W] of the angle between the ray and the surface's normal; 0: no surface
):
    pixel = first + wp.tid()
    width = depth_in.shape[1]
    y = pixel // width
    x = pixel - y * width
    cosine = float(0.0)
    if depth_in[y, x] > 0.0:
        K = K_in[0]
        normal = wp.cross(difference(depth_in, K, x, y, 1, 0, jump), difference(depth_in, K, x, y, 0, 1, jump))
        ray = unprojected(depth_in, K, x, y)
        size = wp.length(normal) * wp.length(ray)
        if size > 0.0:
            cosine = wp.abs(wp.dot(normal, ray)) / size
    cosine_out[y, x] = cosine


@wp.kernel
def fuse(
    first: int,
    # In:
    depth_in: wp.array2d[float],  # [H, W] camera z; 0: no surface
    cosine_in: wp.array2d[float],  # [H, W]
    outline_in: wp.array2d[float],  # [H, W] distance in pixels from the nearest pixel that shows a surface
    viewmat_in: wp.array[wp.mat44],  # [1] world-to-camera
    K_in: wp.array[wp.mat33],  # [1]
    lower: wp.vec3,  # position of voxel 0, 0, 0
    voxel: float,
    ny: int,
    nz: int,
    truncation: float,
    least_cosine: float,
    # In and out:
    sums: wp.array[float],  # [X Y Z] sum of weight times distance over truncation, -1 to 1
    weights: wp.array[float],  # [X Y Z]
):
    i = first + wp.tid()
    ix = i // (ny * nz)
    iy = i // nz - ix * ny
    iz = i - (i // nz) * nz
    view = viewmat_in[0]
    K = K_in[0]
    world = lower + voxel * wp.vec3(float(ix), float(iy), float(iz))
    point = view_rotation(view) * world + wp.vec3(view[0, 3], view[1, 3], view[2, 3])
    if not (point[2] > 0.0):  # conditions with NaN are false, so each states what must hold
        return
    u = K[0, 0] * point[0] / point[2] + K[0, 2] - 0.5
    v = K[1, 1] * point[1] / point[2] + K[1, 2] - 0.5
    height = depth_in.shape[0]
    width = depth_in.shape[1]
    if not (u >= 0.0 and v >= 0.0 and u <= float(width - 1) and v <= float(height - 1)):
        return
    x = wp.min(int(u), width - 2)
    y = wp.min(int(v), height - 2)
    fx = u - float(x)
    fy = v - float(y)
    nearest_x = x + wp.where(fx >= 0.5, 1, 0)
    nearest_y = y + wp.where(fy >= 0.5, 1, 0)
    depth = depth_in[nearest_y, nearest_x]
    if depth == 0.0:
        gap = (outline_in[nearest_y, nearest_x] - 0.5) * point[2] / K[0, 0]
        sums[i] = sums[i] + wp.clamp(gap / truncation, 0.0, 1.0)
        weights[i] = weights[i] + 1.0
        return
    a = depth_in[y, x]
    b = depth_in[y, x + 1]
    c = depth_in[y + 1, x]
    d = depth_in[y + 1, x + 1]
    low = wp.min(wp.min(a, b), wp.min(c, d))
    high = wp.max(wp.max(a, b), wp.max(c, d))
    if low > 0.0 and high - low < truncation:
        depth = (1.0 - fy) * ((1.0 - fx) * a + fx * b) + fy * ((1.0 - fx) * c + fx * d)
    cosine = wp.max(cosine_in[nearest_y, nearest_x], least_cosine)
    slant = wp.length(point) / point[2]
    distance = (depth - point[2]) * slant * cosine
    if not (depth > 0.0 and distance >= -truncation):
        return
    sums[i] = sums[i] + cosine * wp.min(distance / truncation, 1.0)
    weights[i] = weights[i] + cosine
