"""Colour from spherical harmonics of degree 0 to 3 (real basis with the signs of 3D-GS: Plenoxels, supplement A.2)."""

import warp as wp

from .gradient_limits import beyond

wp.set_module_options({"enable_backward": False})

C0 = wp.constant(0.28209479177387814)
C1 = wp.constant(0.48860251190291987)
C2 = wp.constant(1.0925484305920792)
C20 = wp.constant(0.31539156525252005)
C22 = wp.constant(0.5462742152960396)
C33 = wp.constant(0.5900435899266435)
C32 = wp.constant(2.890611442640554)
C31 = wp.constant(0.4570457994644658)
C30 = wp.constant(0.3731763325901154)
C3Z = wp.constant(1.445305721320277)
FACTORS = ("C0", "C1", "C2", "C20", "C22", "C33", "C32", "C31", "C30", "C3Z")
"""Names of the basis functions' constant factors, which the native code shares."""


@wp.func
def view_ray(mean: wp.vec3, camera: wp.vec3):
    """Return the unit direction and 1 / distance; both are 0 where the distance is 0 or non-finite."""
    offset = mean - camera
    squared = wp.dot(offset, offset)
    inverse = float(0.0)
    direction = wp.vec3(0.0)
    if squared > 0.0 and wp.isfinite(squared):
        inverse = 1.0 / wp.sqrt(squared)
        direction = inverse * offset
    return direction, inverse


@wp.func
def not_negative(color: float) -> float:
    """Clamp a colour at 0. A non-finite colour stays non-finite, so that compositing leaves the splat out."""
    return wp.where(color > 0.0, color, color - color)


@wp.func
def not_negative_adjoint(color: float, v: float) -> float:
    """Return the gradient ``v`` of a clamped colour, or 0 where it was clamped or is non-finite."""
    return wp.where(color > 0.0 and wp.isfinite(color), v, 0.0)


@wp.func
def color_of(
    sh_dc: wp.vec3, sh_rest: wp.array[wp.vec3], k: int, mean: wp.vec3, camera: wp.vec3, degree: int
) -> wp.vec3:
    """Return the colour of a Gaussian whose higher coefficients begin at ``k``: >= 0, or non-finite where one of them
    is."""
    color = C0 * sh_dc + wp.vec3(0.5)
    if degree > 0:
        d, _inverse = view_ray(mean, camera)
        x = d[0]
        y = d[1]
        z = d[2]
        color += C1 * (z * sh_rest[k + 1] - y * sh_rest[k] - x * sh_rest[k + 2])
        if degree > 1:
            xx = x * x
            yy = y * y
            zz = z * z
            color += (
                (C2 * x * y) * sh_rest[k + 3]
                - (C2 * y * z) * sh_rest[k + 4]
                + (C20 * (3.0 * zz - 1.0)) * sh_rest[k + 5]
                - (C2 * x * z) * sh_rest[k + 6]
                + (C22 * (xx - yy)) * sh_rest[k + 7]
            )
            if degree > 2:
                color += (
                    (C33 * y * (yy - 3.0 * xx)) * sh_rest[k + 8]
                    + (C32 * x * y * z) * sh_rest[k + 9]
                    + (C31 * y * (1.0 - 5.0 * zz)) * sh_rest[k + 10]
                    + (C30 * z * (5.0 * zz - 3.0)) * sh_rest[k + 11]
                    + (C31 * x * (1.0 - 5.0 * zz)) * sh_rest[k + 12]
                    + (C3Z * z * (xx - yy)) * sh_rest[k + 13]
                    + (C33 * x * (3.0 * yy - xx)) * sh_rest[k + 14]
                )
    return wp.vec3(not_negative(color[0]), not_negative(color[1]), not_negative(color[2]))


@wp.kernel
def spherical_harmonics(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N * dc_row]
    dc_row: int,  # a Gaussian's part of sh_dc_in, of which the first is read
    sh_rest_in: wp.array[wp.vec3],  # [N * rest_row]
    rest_row: int,  # a Gaussian's part of sh_rest_in
    rest_begin: int,  # where the higher coefficients begin in it: 1 if both arrays are the same
    means_in: wp.array[wp.vec3],  # [N]
    camera_in: wp.array[wp.vec3],  # [1] centre of projection
    degree: int,
    # Out:
    colors_out: wp.array[wp.vec3],  # [N] >= 0, or non-finite where a coefficient is
):
    i = first + wp.tid()
    k = i * rest_row + rest_begin
    colors_out[i] = color_of(sh_dc_in[i * dc_row], sh_rest_in, k, means_in[i], camera_in[0], degree)


@wp.kernel
def channels_with_depth(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]
    sh_rest_in: wp.array[wp.vec3],  # [N * R]
    rest: int,  # R
    means_in: wp.array[wp.vec3],  # [N]
    viewmat_in: wp.array2d[float],  # [4, 4]
    depths_in: wp.array[float],  # [N]
    degree: int,
    # Out:
    channels_out: wp.array[wp.vec4],  # [N] colour, then depth
):
    i = first + wp.tid()
    camera = wp.vec3(0.0, 0.0, 0.0)
    for a in range(3):
        for r in range(3):
            camera[a] = camera[a] - viewmat_in[r, a] * viewmat_in[r, 3]
    color = color_of(sh_dc_in[i], sh_rest_in, i * rest, means_in[i], camera, degree)
    channels_out[i] = wp.vec4(color[0], color[1], color[2], depths_in[i])


@wp.kernel
def spherical_harmonics_adjoint(
    first: int,
    # In:
    sh_rest_in: wp.array[wp.vec3],  # [N * rest_row]
    dc_row: int,  # as in the forward pass, for coefficients and gradients
    rest_row: int,
    rest_begin: int,
    means_in: wp.array[wp.vec3],  # [N]
    camera_in: wp.array[wp.vec3],  # [1]
    degree: int,
    colors_in: wp.array[wp.vec3],  # [N] of the forward pass: 0 where clamped
    v_colors_in: wp.array[wp.vec3],  # [N]
    has_rest: int,  # whether v_sh_rest_out is wanted
    has_means: int,  # whether v_means_out is wanted
    # Out:
    v_sh_dc_out: wp.array[wp.vec3],  # [N * dc_row]
    v_sh_rest_out: wp.array[wp.vec3],  # [N * rest_row]
    v_means_out: wp.array[wp.vec3],  # [N]; the camera's is minus their sum
):
    i = first + wp.tid()
    k = i * rest_row + rest_begin
    end = (i + 1) * rest_row
    color = colors_in[i]
    v = v_colors_in[i]
    v = wp.vec3(
        not_negative_adjoint(color[0], v[0]),
        not_negative_adjoint(color[1], v[1]),
        not_negative_adjoint(color[2], v[2]),
    )
    v_sh_dc_out[i * dc_row] = C0 * v
    if has_means != 0:
        v_means_out[i] = wp.vec3(0.0)
    if v[0] == 0.0 and v[1] == 0.0 and v[2] == 0.0:
        # The Gaussian is culled or clamped: its coefficients need not be read, and a NaN among them must not spread.
        if has_rest != 0:
            for j in range(k, end):
                v_sh_rest_out[j] = wp.vec3(0.0)
        return
    d, inverse = view_ray(means_in[i], camera_in[0])
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    zz = z * z
    if has_rest != 0:
        used = int(0)
        if degree > 0:
            v_sh_rest_out[k] = (-C1 * y) * v
            v_sh_rest_out[k + 1] = (C1 * z) * v
            v_sh_rest_out[k + 2] = (-C1 * x) * v
            used = 3
        if degree > 1:
            v_sh_rest_out[k + 3] = (C2 * x * y) * v
            v_sh_rest_out[k + 4] = (-C2 * y * z) * v
            v_sh_rest_out[k + 5] = (C20 * (3.0 * zz - 1.0)) * v
            v_sh_rest_out[k + 6] = (-C2 * x * z) * v
            v_sh_rest_out[k + 7] = (C22 * (xx - yy)) * v
            used = 8
        if degree > 2:
            v_sh_rest_out[k + 8] = (C33 * y * (yy - 3.0 * xx)) * v
            v_sh_rest_out[k + 9] = (C32 * x * y * z) * v
            v_sh_rest_out[k + 10] = (C31 * y * (1.0 - 5.0 * zz)) * v
            v_sh_rest_out[k + 11] = (C30 * z * (5.0 * zz - 3.0)) * v
            v_sh_rest_out[k + 12] = (C31 * x * (1.0 - 5.0 * zz)) * v
            v_sh_rest_out[k + 13] = (C3Z * z * (xx - yy)) * v
            v_sh_rest_out[k + 14] = (C33 * x * (3.0 * yy - xx)) * v
            used = 15
        for j in range(k + used, end):
            v_sh_rest_out[j] = wp.vec3(0.0)
    if has_means == 0 or degree == 0:
        return

    g = C1 * wp.vec3(-wp.dot(sh_rest_in[k + 2], v), -wp.dot(sh_rest_in[k], v), wp.dot(sh_rest_in[k + 1], v))
    if degree > 1:
        s4 = C2 * wp.dot(sh_rest_in[k + 3], v)
        s5 = C2 * wp.dot(sh_rest_in[k + 4], v)
        s6 = 6.0 * C20 * wp.dot(sh_rest_in[k + 5], v)
        s7 = C2 * wp.dot(sh_rest_in[k + 6], v)
        s8 = 2.0 * C22 * wp.dot(sh_rest_in[k + 7], v)
        g += wp.vec3(s4 * y - s7 * z + s8 * x, s4 * x - s5 * z - s8 * y, s6 * z - s5 * y - s7 * x)
    if degree > 2:
        s9 = 3.0 * C33 * wp.dot(sh_rest_in[k + 8], v)
        s10 = C32 * wp.dot(sh_rest_in[k + 9], v)
        s11 = C31 * wp.dot(sh_rest_in[k + 10], v)
        s12 = 3.0 * C30 * wp.dot(sh_rest_in[k + 11], v)
        s13 = C31 * wp.dot(sh_rest_in[k + 12], v)
        s14 = C3Z * wp.dot(sh_rest_in[k + 13], v)
        s15 = 3.0 * C33 * wp.dot(sh_rest_in[k + 14], v)
        g += wp.vec3(
            -2.0 * s9 * x * y + s10 * y * z + s13 * (1.0 - 5.0 * zz) + 2.0 * s14 * x * z + s15 * (yy - xx),
            s9 * (yy - xx) + s10 * x * z + s11 * (1.0 - 5.0 * zz) - 2.0 * s14 * y * z + 2.0 * s15 * x * y,
            s10 * x * y - 10.0 * z * (s11 * y + s13 * x) + s12 * (5.0 * zz - 1.0) + s14 * (xx - yy),
        )
    # Only a gradient's component perpendicular to the direction counts, because the direction is normalised.
    v_mean = inverse * (g - wp.dot(g, d) * d)
    if beyond(v_mean) == 0:
        v_means_out[i] = v_mean  # an overflowing gradient is left out
