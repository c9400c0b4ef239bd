"""Depth of the surface that Gaussians form, per pixel: where the opacity accumulated along the ray reaches a level.

The depth that blending returns is a mean of the Gaussians' centres, which lies behind the visible surface and mixes
surfaces at outlines. Here each Gaussian is followed along the ray itself: on it, the falloff is that of a Gaussian in
one dimension, with its peak at ``t_i`` and the deviation ``sigma_i``. Up to depth t it contributes::

    alpha_i(t) = o_i falloff(q_i + ((t - t_i) / sigma_i)^2)  if t < t_i, else o_i falloff(q_i)

and the surface is at the t where ``1 - prod_i (1 - alpha_i(t))`` reaches the level: the opacity field of Gaussian
Opacity Fields (Yu et al. 2024), for the project's splats. The result does not depend on the order of the splats.
"""

from __future__ import annotations

import warp as wp

from .compositing import squared_distance
from .falloff import falloff
from .projection import view_rotation
from .quaternion import quat_matrix, quat_normalise
from .types import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

wp.set_module_options({"enable_backward": False})

CONTRIBUTORS = 32
"""Largest number of splats of a pixel whose falloff along the ray is followed; further ones only end the ray."""
BISECTIONS = wp.constant(14)
"""Number of halvings: the interval of some deviations ends at a thousandth of one."""
REACH = wp.constant(3.5)
"""Distance before its peak, in deviations, from which a Gaussian contributes."""
LEAST_SCALE = wp.constant(1.0e-6)
"""Smallest deviation relative to the depth, which keeps the inverse of flat Gaussians finite."""

Contributions = wp.types.vector(length=CONTRIBUTORS, dtype=wp.float32)


@wp.kernel
def whiten(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N] wxyz, any norm
    scales_in: wp.array[wp.vec3],  # [N]
    viewmat_in: wp.array[wp.mat44],  # [1] world-to-camera
    # Out:
    points_out: wp.array[wp.vec3],  # [N] means in the camera's frame
    whitenings_out: wp.array[wp.mat33],  # [N] maps offsets in the camera's frame to units of the deviations
):
    i = first + wp.tid()
    view = viewmat_in[0]
    rotation = view_rotation(view)
    point = rotation * means_in[i] + wp.vec3(view[0, 3], view[1, 3], view[2, 3])
    axes = rotation * quat_matrix(quat_normalise(quats_in[i]))
    least = LEAST_SCALE * wp.abs(point[2]) + 1.0e-30
    scale = scales_in[i]
    inverse = wp.vec3(1.0 / wp.max(scale[0], least), 1.0 / wp.max(scale[1], least), 1.0 / wp.max(scale[2], least))
    points_out[i] = point
    whitenings_out[i] = wp.diag(inverse) * wp.transpose(axes)


@wp.func
def opacity_until(
    t: float,
    count: int,
    peaks: Contributions,
    deviations: Contributions,
    distances: Contributions,
    opacities: Contributions,
    sharpness: float,
) -> float:
    """Return the opacity accumulated along a ray up to depth ``t``."""
    transmittance = float(1.0)
    for k in range(count):
        x = wp.min((t - peaks[k]) / deviations[k], 0.0)
        if x > -REACH:
            alpha = wp.min(ALPHA_MAX, opacities[k] * falloff(distances[k] + x * x, sharpness))
            transmittance *= 1.0 - alpha
    return 1.0 - transmittance


@wp.kernel
def surface_depth(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N] pixels
    conics_in: wp.array[wp.vec3],  # [N] 1 / px^2
    opacities_in: wp.array[float],  # [N]
    points_in: wp.array[wp.vec3],  # [N] camera's frame
    whitenings_in: wp.array[wp.mat33],  # [N]
    K_in: wp.array[wp.mat33],  # [1]
    ranges_in: wp.array[wp.vec2i],  # [T] begin and end of each tile in the sorted list
    splats_in: wp.array[int],  # [P] the sorted list
    width: int,
    columns: int,
    sharpness: float,
    tile_size: int,
    level: float,
    # Out:
    depth_out: wp.array2d[float],  # [H, W] camera z; 0 where the ray does not reach the level
):
    pixel = first + wp.tid()
    y = pixel // width
    x = pixel - y * width
    centre = wp.vec2(float(x) + 0.5, float(y) + 0.5)
    K = K_in[0]
    ray = wp.vec3((centre[0] - K[0, 2]) / K[0, 0], (centre[1] - K[1, 2]) / K[1, 1], 1.0)
    span = ranges_in[(y // tile_size) * columns + x // tile_size]
    peaks = Contributions()
    deviations = Contributions()
    distances = Contributions()
    opacities = Contributions()
    count = int(0)
    transmittance = float(1.0)
    near = float(1.0e30)
    far = float(0.0)
    for p in range(span[0], span[1]):
        i = splats_in[p]
        q = squared_distance(conics_in[i], centre - means2d_in[i])
        alpha = wp.min(ALPHA_MAX, opacities_in[i] * falloff(q, sharpness))
        if not (q >= 0.0 and alpha >= ALPHA_MIN):
            continue
        if transmittance * (1.0 - alpha) <= TRANSMITTANCE_MIN and count > 0:
            if 1.0 - transmittance >= level:
                break
        point = points_in[i]
        along = whitenings_in[i] * ray
        across = whitenings_in[i] * (point - point[2] * ray)
        squared = wp.dot(along, along)
        peak = point[2] + wp.dot(along, across) / squared
        if not (wp.isfinite(peak) and peak > 0.0 and squared > 0.0):
            continue
        if count < CONTRIBUTORS:
            peaks[count] = peak
            deviations[count] = 1.0 / wp.sqrt(squared)
            distances[count] = q
            opacities[count] = opacities_in[i]
            near = wp.min(near, peak - REACH * deviations[count])
            far = wp.max(far, peak)
            count += 1
        elif 1.0 - transmittance < level:
            far = peak  # the list is full of thin fog: the splat that ends it is the surface
        transmittance *= 1.0 - alpha
    depth = float(0.0)
    if 1.0 - transmittance >= level:
        depth = far
        if opacity_until(far, count, peaks, deviations, distances, opacities, sharpness) >= level:
            low = wp.max(near, 0.0)
            high = far
            for _ in range(BISECTIONS):
                middle = 0.5 * (low + high)
                if opacity_until(middle, count, peaks, deviations, distances, opacities, sharpness) >= level:
                    high = middle
                else:
                    low = middle
            depth = 0.5 * (low + high)
    depth_out[y, x] = depth
