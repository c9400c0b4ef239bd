"""EWA splatting: a 3D Gaussian becomes a 2D one (Zwicker et al. 2002, equations 24 to 31; conventions of gsplat 1.5.3).

With ``A = R_view R(q) S`` (the Gaussian's axes in the camera's frame) and the Jacobian ``J`` of the perspective, the 2D
covariance is ``(J A)(J A)^T``. Its determinant is the squared norm of the cross product of the two rows of ``J A``,
which loses no digits where the Gaussian is seen edge-on. The adjoint recomputes these intermediate values, which costs
less than storing and reading them.
"""

import warp as wp

from .falloff import sharp_reach
from .gradient_limits import beyond
from .quaternion import quat_inverse_norm, quat_matrix, quat_matrix_adjoint, quat_normalise, quat_normalise_adjoint
from .types import ALPHA_MIN

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

_BOUNDS = (256, 5)
"""Launch bounds of ``project`` on a GPU: threads per block, and blocks per multiprocessor, which leave it 48 registers
and spill none. The adjoint would spill with 80."""

FRUSTUM_MARGIN = wp.constant(0.3)
"""Margin outside the image, in tan(fov / 2), beyond which x / z and y / z are clamped: the Jacobian would explode."""

RADIUS_MAX = wp.constant(1.0e9)
"""Largest radius in pixels. It covers every image, and a larger float would overflow int32."""


@wp.struct
class Footprint:
    """A Gaussian in front of one camera."""

    point: wp.vec3  # mean in the camera's frame
    slope: wp.vec2  # x / z and y / z, clamped to the widened frustum
    free: wp.vec2  # 1 where the clamp left the slope alone, else 0
    scale: wp.vec2  # f / z
    axes: wp.mat33  # R_view R(q), without the scales
    row_x: wp.vec3  # first row of J A
    row_y: wp.vec3  # second


@wp.func
def view_rotation(view: wp.mat44) -> wp.mat33:
    return wp.mat33(
        view[0, 0],
        view[0, 1],
        view[0, 2],
        view[1, 0],
        view[1, 1],
        view[1, 2],
        view[2, 0],
        view[2, 1],
        view[2, 2],
    )


@wp.func
def footprint(
    mean: wp.vec3, unit: wp.vec4, scale: wp.vec3, view: wp.mat44, K: wp.mat33, width: float, height: float
) -> Footprint:
    fp = Footprint()
    rotation = view_rotation(view)
    fp.point = rotation * mean + wp.vec3(view[0, 3], view[1, 3], view[2, 3])
    near = 1.0 / fp.point[2]
    margin_x = FRUSTUM_MARGIN * 0.5 * width / K[0, 0]
    margin_y = FRUSTUM_MARGIN * 0.5 * height / K[1, 1]
    slope = near * wp.vec2(fp.point[0], fp.point[1])
    fp.slope = wp.vec2(
        wp.clamp(slope[0], -K[0, 2] / K[0, 0] - margin_x, (width - K[0, 2]) / K[0, 0] + margin_x),
        wp.clamp(slope[1], -K[1, 2] / K[1, 1] - margin_y, (height - K[1, 2]) / K[1, 1] + margin_y),
    )
    fp.free = wp.vec2(wp.where(fp.slope[0] == slope[0], 1.0, 0.0), wp.where(fp.slope[1] == slope[1], 1.0, 0.0))
    fp.scale = near * wp.vec2(K[0, 0], K[1, 1])
    fp.axes = rotation * quat_matrix(unit)
    forward = wp.cw_mul(fp.axes[2], scale)
    fp.row_x = fp.scale[0] * (wp.cw_mul(fp.axes[0], scale) - fp.slope[0] * forward)
    fp.row_y = fp.scale[1] * (wp.cw_mul(fp.axes[1], scale) - fp.slope[1] * forward)
    return fp


@wp.kernel(launch_bounds=_BOUNDS)
def project(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N] wxyz, any norm
    scales_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    viewmat_in: wp.array[wp.mat44],  # [1] world-to-camera
    K_in: wp.array[wp.mat33],  # [1]
    width: int,
    height: int,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    eps2d: float,
    antialiased: int,
    sharpness: float,
    # Out: (all zero where culled)
    means2d_out: wp.array[wp.vec2],  # [N]
    conics_out: wp.array[wp.vec3],  # [N]
    depths_out: wp.array[float],  # [N]
    opacities_out: wp.array[float],  # [N]
    radii_out: wp.array[wp.vec2i],  # [N]
):
    i = first + wp.tid()
    K = K_in[0]
    w = float(width)
    h = float(height)
    quat = quats_in[i]
    fp = footprint(means_in[i], quat_normalise(quat), scales_in[i], viewmat_in[0], K, w, h)
    z = fp.point[2]
    mean2d = wp.vec2(
        fp.scale[0] * fp.point[0] + K[0, 2],
        fp.scale[1] * fp.point[1] + K[1, 2],
    )

    raw_xx = wp.dot(fp.row_x, fp.row_x)
    raw_yy = wp.dot(fp.row_y, fp.row_y)
    xy = wp.dot(fp.row_x, fp.row_y)
    normal = wp.cross(fp.row_x, fp.row_y)
    raw_determinant = wp.dot(normal, normal)
    xx = raw_xx + eps2d
    yy = raw_yy + eps2d
    determinant = raw_determinant + eps2d * (raw_xx + raw_yy + eps2d)
    opacity = opacities_in[i]
    if antialiased != 0:
        opacity *= wp.sqrt(raw_determinant / determinant)

    conic = wp.vec3(0.0)
    radii = wp.vec2i(0, 0)
    depth = float(0.0)
    # Comparisons with NaN are false. Each condition states what must hold, so that NaN is culled.
    visible = z > 0.0 and z >= near_plane and z <= far_plane and opacity >= ALPHA_MIN and wp.isfinite(opacity)
    visible = visible and determinant > 0.0 and quat_inverse_norm(quat) > 0.0
    if visible:
        extent = wp.sqrt(2.0 * sharp_reach(wp.max(wp.log(opacity / ALPHA_MIN), 0.0), sharpness))
        radius_x = wp.min(wp.ceil(extent * wp.sqrt(xx)), RADIUS_MAX)
        radius_y = wp.min(wp.ceil(extent * wp.sqrt(yy)), RADIUS_MAX)
        conic = wp.vec3(yy, -xy, xx) / determinant
        visible = wp.max(radius_x, radius_y) > radius_clip and radius_x > 0.0 and radius_y > 0.0
        visible = visible and mean2d[0] + radius_x > 0.0 and mean2d[0] - radius_x < w
        visible = visible and mean2d[1] + radius_y > 0.0 and mean2d[1] - radius_y < h
        # The sum is finite only if every term is.
        visible = visible and wp.isfinite(conic[0] + conic[2] + xx + yy) and wp.isfinite(conic[1])
        visible = visible and wp.isfinite(mean2d[0]) and wp.isfinite(mean2d[1]) and wp.isfinite(z)
        if visible:
            radii = wp.vec2i(int(radius_x), int(radius_y))
            depth = z
    if not visible:
        mean2d = wp.vec2(0.0)
        conic = wp.vec3(0.0)
        opacity = 0.0
    means2d_out[i] = mean2d
    conics_out[i] = conic
    depths_out[i] = depth
    opacities_out[i] = opacity
    radii_out[i] = radii


@wp.func
def covariance2d_adjoint(
    row_x: wp.vec3, row_y: wp.vec3, eps2d: float, antialiased: int, opacity: float, v_conic: wp.vec3, v_opacity: float
):
    """Compute the gradients v_xx, v_xy (counted once) and v_yy of the 2D covariance, and that of the input opacity.

    The input opacity is the one before the antialiasing compensation.
    """
    raw_xx = wp.dot(row_x, row_x)
    raw_yy = wp.dot(row_y, row_y)
    xy = wp.dot(row_x, row_y)
    normal = wp.cross(row_x, row_y)
    raw_determinant = wp.dot(normal, normal)
    determinant = raw_determinant + eps2d * (raw_xx + raw_yy + eps2d)
    a = (raw_yy + eps2d) / determinant
    b = -xy / determinant
    c = (raw_xx + eps2d) / determinant
    # d(inverse) = - inverse d(covariance) inverse
    v_xx = -(a * a * v_conic[0] + a * b * v_conic[1] + b * b * v_conic[2])
    v_xy = -(2.0 * a * b * v_conic[0] + (a * c + b * b) * v_conic[1] + 2.0 * b * c * v_conic[2])
    v_yy = -(b * b * v_conic[0] + b * c * v_conic[1] + c * c * v_conic[2])
    v_opacity_in = v_opacity
    if antialiased != 0:
        ratio = raw_determinant / determinant
        factor = wp.sqrt(ratio)
        v_opacity_in = factor * v_opacity
        half = 0.5 * opacity * v_opacity / (factor * determinant)  # factor > 0: culled otherwise
        v_xx += half * (raw_yy - ratio * (raw_yy + eps2d))
        v_yy += half * (raw_xx - ratio * (raw_xx + eps2d))
        v_xy += half * (-2.0 * xy * (1.0 - ratio))
    return v_xx, v_xy, v_yy, v_opacity_in


@wp.kernel
def project_adjoint(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N]
    scales_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    viewmat_in: wp.array[wp.mat44],  # [1]
    K_in: wp.array[wp.mat33],  # [1]
    width: int,
    height: int,
    eps2d: float,
    antialiased: int,
    radii_in: wp.array[wp.vec2i],  # [N] of the forward pass: (0, 0) where culled
    v_means2d_in: wp.array[wp.vec2],  # [N]
    v_conics_in: wp.array[wp.vec3],  # [N]
    v_depths_in: wp.array[float],  # [N], null: zero
    v_opacities_in: wp.array[float],  # [N]
    has_view: int,  # whether v_views_out is wanted
    # Out:
    v_means_out: wp.array[wp.vec3],  # [N]
    v_quats_out: wp.array[wp.vec4],  # [N]
    v_scales_out: wp.array[wp.vec3],  # [N]
    v_opacities_out: wp.array[float],  # [N]
    v_views_out: wp.array2d[wp.vec3],  # [N, 4] each Gaussian's share: three columns of the rotation, translation
):
    i = first + wp.tid()
    if radii_in[i][0] == 0:
        v_means_out[i] = wp.vec3(0.0)
        v_quats_out[i] = wp.vec4(0.0)
        v_scales_out[i] = wp.vec3(0.0)
        v_opacities_out[i] = 0.0
        if has_view != 0:
            for column in range(4):
                v_views_out[i, column] = wp.vec3(0.0)
        return
    mean = means_in[i]
    quat = quats_in[i]
    scale = scales_in[i]
    unit = quat_normalise(quat)
    view = viewmat_in[0]
    fp = footprint(mean, unit, scale, view, K_in[0], float(width), float(height))
    v_xx, v_xy, v_yy, v_opacity = covariance2d_adjoint(
        fp.row_x, fp.row_y, eps2d, antialiased, opacities_in[i], v_conics_in[i], v_opacities_in[i]
    )
    v_row_x = 2.0 * v_xx * fp.row_x + v_xy * fp.row_y
    v_row_y = 2.0 * v_yy * fp.row_y + v_xy * fp.row_x

    # rows = scale (axis - slope forward), with the Gaussian's scales inside axis and forward
    axis_x = fp.scale[0] * v_row_x
    axis_y = fp.scale[1] * v_row_y
    forward = -fp.slope[0] * axis_x - fp.slope[1] * axis_y
    v_scaled = wp.matrix_from_rows(axis_x, axis_y, forward)
    v_scale = wp.vec3(
        axis_x[0] * fp.axes[0, 0] + axis_y[0] * fp.axes[1, 0] + forward[0] * fp.axes[2, 0],
        axis_x[1] * fp.axes[0, 1] + axis_y[1] * fp.axes[1, 1] + forward[1] * fp.axes[2, 1],
        axis_x[2] * fp.axes[0, 2] + axis_y[2] * fp.axes[1, 2] + forward[2] * fp.axes[2, 2],
    )
    v_axes = v_scaled * wp.diag(scale)
    rotation = view_rotation(view)
    v_unit = quat_matrix_adjoint(unit, wp.transpose(rotation) * v_axes)
    v_quat = quat_normalise_adjoint(quat, v_unit)

    # slope = point.xy / z (clamped), scale = f / z, mean2d = scale point.xy + centre
    near = 1.0 / fp.point[2]
    deep = wp.cw_mul(fp.axes[2], scale)
    v_slope_x = -wp.dot(axis_x, deep) * fp.free[0]
    v_slope_y = -wp.dot(axis_y, deep) * fp.free[1]
    v_mean2d = v_means2d_in[i]
    v_x = v_mean2d[0] * fp.scale[0] + v_slope_x * near
    v_y = v_mean2d[1] * fp.scale[1] + v_slope_y * near
    # Every term but depth falls with 1 / z. (row / scale) scale' = -row / z.
    v_z = -near * (v_x * fp.point[0] + v_y * fp.point[1] + wp.dot(v_row_x, fp.row_x) + wp.dot(v_row_y, fp.row_y))
    v_depth = float(0.0)
    if v_depths_in:
        v_depth = v_depths_in[i]
    v_z += v_depth
    v_point = wp.vec3(v_x, v_y, v_z)
    v_mean = wp.transpose(rotation) * v_point
    v_rotation = wp.mat33(0.0)
    if has_view != 0:
        v_rotation = wp.outer(v_point, mean) + v_axes * wp.transpose(quat_matrix(unit))

    # If usable incoming gradients overflow here, pass zeros; an incoming NaN stays NaN.
    given = beyond(v_mean2d[0]) + beyond(v_mean2d[1]) + beyond(v_depth) + beyond(v_opacities_in[i])
    given += beyond(v_conics_in[i])
    made = beyond(v_opacity) + beyond(v_mean) + beyond(v_scale) + beyond(v_quat) + beyond(v_point)
    made += beyond(v_rotation[0]) + beyond(v_rotation[1]) + beyond(v_rotation[2])
    if given == 0 and made > 0:
        v_mean = wp.vec3(0.0)
        v_quat = wp.vec4(0.0)
        v_scale = wp.vec3(0.0)
        v_opacity = 0.0
        v_point = wp.vec3(0.0)
        v_rotation = wp.mat33(0.0)
    v_means_out[i] = v_mean
    v_quats_out[i] = v_quat
    v_scales_out[i] = v_scale
    v_opacities_out[i] = v_opacity
    if has_view != 0:
        for column in range(3):
            v_views_out[i, column] = wp.vec3(v_rotation[0, column], v_rotation[1, column], v_rotation[2, column])
        v_views_out[i, 3] = v_point
