"""Distances between spheres and an image's silhouette, in the image.

Each sphere's projected centre is compared with a table of distances to the silhouette, and each of the silhouette's
pixels with the centre nearest to it. Lengths are in units of the image's width.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

NEAREST_DEPTH = wp.constant(1e-2)
"""Depth, normalised, below which a centre is treated as if it had this depth."""


@wp.func
def in_camera(mean: wp.vec3, view: wp.mat44) -> wp.vec3:
    """Return a position in the camera's frame."""
    local = wp.vec3()
    for r in range(3):
        local[r] = mean[0] * view[r, 0] + mean[1] * view[r, 1] + mean[2] * view[r, 2] + view[r, 3]
    return local


@wp.func
def limited_depth(local: wp.vec3) -> float:
    """Return the depth by which a position is divided. NaN stays."""
    return wp.where(local[2] < NEAREST_DEPTH, NEAREST_DEPTH, local[2])


@wp.func
def in_image(local: wp.vec3, K: wp.mat33) -> wp.vec2:
    """Return a position's pixel coordinates."""
    depth = limited_depth(local)
    x = (local[0] * K[0, 0] + local[1] * K[0, 1] + local[2] * K[0, 2]) / depth
    y = (local[0] * K[1, 0] + local[1] * K[1, 1] + local[2] * K[1, 2]) / depth
    return wp.vec2(x, y)


@wp.func
def in_table(coordinate: float, size: float, count: int) -> float:
    """Return the index of a coordinate among ``count`` samples at the centres of equal parts of ``size``."""
    return coordinate / size * float(count) - 0.5


@wp.func
def within(index: float, count: int) -> float:
    """Limit an index to the samples. NaN becomes 0, so that it may be converted to an integer."""
    above = wp.where(index > 0.0, index, 0.0)
    return wp.where(above < float(count - 1), above, float(count - 1))


@wp.func
def slope(change: float, index: float, count: int, size: float) -> float:
    """Return the change per unit of length; 0 where the index is limited."""
    return wp.where(index > 0.0 and index < float(count - 1), change * (float(count) / size), 0.0)


@wp.kernel
def project_spheres(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N] centres
    viewmat_in: wp.array[wp.mat44],  # [1] world-to-camera
    K_in: wp.array[wp.mat33],  # [1] pixels
    width: int,  # of the image, pixels
    distances_in: wp.array2d[float],  # [h, w] distances to the silhouette
    size_in: wp.array[float],  # [2] width and height of the table
    # Out:
    points_out: wp.array[wp.vec2],  # [N] projected centres
    slopes_out: wp.array[wp.vec2],  # [N] gradients of the sampled distances
    parts_out: wp.array[float],  # [N + P] the first N: distances to the silhouette, divided by N
):
    """Project a centre and sample the table there, bilinearly, beyond its border as at the border. Grid: N."""
    i = first + wp.tid()
    point = in_image(in_camera(means_in[i], viewmat_in[0]), K_in[0]) / float(width)
    rows = distances_in.shape[0]
    columns = distances_in.shape[1]
    x = in_table(point[0], size_in[0], columns)
    y = in_table(point[1], size_in[1], rows)
    left = int(within(x, columns))
    top = int(within(y, rows))
    right = wp.min(left + 1, columns - 1)
    bottom = wp.min(top + 1, rows - 1)
    a = within(x, columns) - float(left)
    b = within(y, rows) - float(top)
    upper = (1.0 - a) * distances_in[top, left] + a * distances_in[top, right]
    lower = (1.0 - a) * distances_in[bottom, left] + a * distances_in[bottom, right]
    along_x = (1.0 - b) * (distances_in[top, right] - distances_in[top, left])
    along_x = along_x + b * (distances_in[bottom, right] - distances_in[bottom, left])
    strayed = (1.0 - b) * upper + b * lower
    if wp.isnan(point[0]) or wp.isnan(point[1]):
        strayed = point[0] + point[1]
    points_out[i] = point
    slopes_out[i] = wp.vec2(
        slope(along_x, x, columns, size_in[0]), slope(lower - upper, y, rows, size_in[1])
    )  # fmt: skip
    parts_out[i] = strayed / float(means_in.shape[0])


@wp.kernel
def nearest_spheres(
    first: int,
    # In:
    points_in: wp.array[wp.vec2],  # [N] projected centres
    pixels_in: wp.array[wp.vec2],  # [P] of the silhouette
    # Out:
    indices_out: wp.array[wp.int32],  # [P] nearest centre, the first of several
    directions_out: wp.array[wp.vec2],  # [P] unit, from the pixel to the centre; 0 where they coincide
    parts_out: wp.array[float],  # [N + P] the last P: distances to the nearest centre, divided by P
):
    """Find the centre that is nearest to a pixel. Grid: P."""
    p = first + wp.tid()
    pixel = pixels_in[p]
    count = points_in.shape[0]
    least = float(wp.inf)
    index = int(0)
    for i in range(count):
        x = points_in[i][0] - pixel[0]
        y = points_in[i][1] - pixel[1]
        squared = x * x + y * y
        if squared < least:
            least = squared
            index = i
    distance = wp.sqrt(least)
    direction = wp.vec2(0.0, 0.0)
    if distance > 0.0:
        direction = (points_in[index] - pixel) / distance
    indices_out[p] = index
    directions_out[p] = direction
    parts_out[count + p] = distance / float(pixels_in.shape[0])


@wp.kernel
def project_spheres_adjoint(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    viewmat_in: wp.array[wp.mat44],  # [1]
    K_in: wp.array[wp.mat33],  # [1]
    width: int,
    slopes_in: wp.array[wp.vec2],  # [N]
    indices_in: wp.array[wp.int32],  # [P]
    directions_in: wp.array[wp.vec2],  # [P]
    v_term_in: wp.array[float],  # [1] gradient of the sum of all parts
    # Out:
    v_means_out: wp.array[wp.vec3],  # [N]
):
    """Compute the gradient of a centre from the table's slope and from the pixels that are nearest to it. Grid: N."""
    i = first + wp.tid()
    pull = wp.vec2(0.0, 0.0)
    pixels = indices_in.shape[0]
    for p in range(pixels):
        if indices_in[p] == i:
            pull = pull + directions_in[p]
    v_point = v_term_in[0] * (slopes_in[i] / float(means_in.shape[0]) + pull / float(pixels))
    view = viewmat_in[0]
    K = K_in[0]
    local = in_camera(means_in[i], view)
    place = in_image(local, K)
    depth = limited_depth(local)
    v_x = v_point[0] / float(width) / depth
    v_y = v_point[1] / float(width) / depth
    v_depth = float(0.0)
    if not (local[2] < NEAREST_DEPTH):
        v_depth = -(v_x * place[0] + v_y * place[1])
    v_local = wp.vec3(
        v_x * K[0, 0] + v_y * K[1, 0], v_x * K[0, 1] + v_y * K[1, 1], v_x * K[0, 2] + v_y * K[1, 2] + v_depth
    )
    v_mean = wp.vec3()
    for c in range(3):
        v_mean[c] = v_local[0] * view[0, c] + v_local[1] * view[1, c] + v_local[2] * view[2, c]
    v_means_out[i] = v_mean
