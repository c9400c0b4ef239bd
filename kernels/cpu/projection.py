"""``projection`` on a CPU: 16 Gaussians at a time in SIMD registers. Same formulas, same conventions, same culling."""

from __future__ import annotations

import warp as wp

from ..projection import FRUSTUM_MARGIN, RADIUS_MAX
from ..types import ALPHA_MIN, GRADIENT_MAX
from .simd import SIMD

wp.set_module_options({"enable_backward": False})

LANES = 16

_PRELUDE = f"""
#if !defined(__CUDA_ARCH__)
    {SIMD}
    const float ALPHA_MIN = {float(ALPHA_MIN)!r}f, MARGIN = {float(FRUSTUM_MARGIN)!r}f;
    const float RADIUS_MAX = {float(RADIUS_MAX)!r}f, INFINITE = __builtin_inff();
    const float GRADIENT_MAX = {float(GRADIENT_MAX)!r}f;
    const vf ONE = ZERO + 1.0f;
    const int total = means.shape.dims[0], n = total - begin < 16 ? total - begin : 16;
    // Rows of C floats to C vectors with a Gaussian a lane, and back; lanes past the end are 0.
    auto gather = [&](const float* from, vf* to, auto columns) {{
        constexpr int C = decltype(columns)::value;
        float lanes[C][16] = {{}};
        for (int l = 0; l < n; ++l) for (int c = 0; c < C; ++c) lanes[c][l] = from[C * (begin + l) + c];
        __builtin_memcpy(to, lanes, sizeof(lanes));
    }};
    auto scatter = [&](float* to, const vf* from, auto columns) {{
        constexpr int C = decltype(columns)::value;
        float lanes[C][16];
        __builtin_memcpy(lanes, from, sizeof(lanes));
        for (int l = 0; l < n; ++l) for (int c = 0; c < C; ++c) to[C * (begin + l) + c] = lanes[c][l];
    }};
    struct One {{ enum {{ value = 1 }}; }};
    struct Two {{ enum {{ value = 2 }}; }};
    struct Three {{ enum {{ value = 3 }}; }};
    struct Four {{ enum {{ value = 4 }}; }};
    auto root = [](vf v) -> vf {{ return __builtin_elementwise_sqrt(v); }};
    auto finite = [&](vf v) -> vi {{ return __builtin_elementwise_abs(v) < INFINITE; }};  // false for NaN
    auto dot = [](const vf* a, const vf* b) -> vf {{ return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }};

    const float* view = (const float*)viewmat.data;  // rows of 4
    const float* K = (const float*)intrinsics.data;
    const float fx = K[0], cx = K[2], fy = K[4], cy = K[5], w = (float)width, h = (float)height;
    vf mean[3], quat[4], scale[3], opacity[1];
    gather((const float*)means.data, mean, Three());
    gather((const float*)quats.data, quat, Four());
    gather((const float*)scales.data, scale, Three());
    gather(opacities.data, opacity, One());

    vf point[3];
    for (int r = 0; r < 3; ++r)
        point[r] = view[4 * r] * mean[0] + view[4 * r + 1] * mean[1] + view[4 * r + 2] * mean[2] + view[4 * r + 3];
    const vf near = 1.0f / point[2];
    const vf squared = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
    const vf inverse_norm = squared > 0.0f ? 1.0f / root(squared) : ZERO;
    vf unit[4];
    for (int c = 0; c < 4; ++c) unit[c] = inverse_norm > 0.0f ? inverse_norm * quat[c] : ZERO + (c == 0 ? 1.0f : 0.0f);
    const vf &qw = unit[0], &qx = unit[1], &qy = unit[2], &qz = unit[3];
    const vf turn[3][3] = {{
        {{1.0f - 2.0f * (qy * qy + qz * qz), 2.0f * (qx * qy - qw * qz), 2.0f * (qx * qz + qw * qy)}},
        {{2.0f * (qx * qy + qw * qz), 1.0f - 2.0f * (qx * qx + qz * qz), 2.0f * (qy * qz - qw * qx)}},
        {{2.0f * (qx * qz - qw * qy), 2.0f * (qy * qz + qw * qx), 1.0f - 2.0f * (qx * qx + qy * qy)}}}};
    vf axes[3][3];
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c)
            axes[r][c] = view[4 * r] * turn[0][c] + view[4 * r + 1] * turn[1][c] + view[4 * r + 2] * turn[2][c];
    auto clamp = [&](vf v, float low, float high) -> vf {{
        v = v < low ? ZERO + low : v;
        return v > high ? ZERO + high : v;
    }};
    const vf raw_slope_x = near * point[0], raw_slope_y = near * point[1];
    const float margin_x = MARGIN * 0.5f * w / fx, margin_y = MARGIN * 0.5f * h / fy;
    const vf slope_x = clamp(raw_slope_x, -cx / fx - margin_x, (w - cx) / fx + margin_x);
    const vf slope_y = clamp(raw_slope_y, -cy / fy - margin_y, (h - cy) / fy + margin_y);
    const vf scale_x = near * fx, scale_y = near * fy;
    vf deep[3], row_x[3], row_y[3];
    for (int c = 0; c < 3; ++c) {{
        deep[c] = axes[2][c] * scale[c];
        row_x[c] = scale_x * (axes[0][c] * scale[c] - slope_x * deep[c]);
        row_y[c] = scale_y * (axes[1][c] * scale[c] - slope_y * deep[c]);
    }}
    const vf raw_xx = dot(row_x, row_x), raw_yy = dot(row_y, row_y), xy = dot(row_x, row_y);
    const vf normal[3] = {{row_x[1] * row_y[2] - row_x[2] * row_y[1], row_x[2] * row_y[0] - row_x[0] * row_y[2],
        row_x[0] * row_y[1] - row_x[1] * row_y[0]}};
    const vf raw_determinant = dot(normal, normal);
    const vf xx = raw_xx + eps2d, yy = raw_yy + eps2d;
    const vf determinant = raw_determinant + eps2d * (raw_xx + raw_yy + eps2d);
"""

_FORWARD = (
    _PRELUDE
    + """
    // Natural logarithm of v >= 1: v = 2^e f with f in [sqrt(1/2), sqrt(2)), and a polynomial in f - 1 (error 1e-7).
    auto logarithm = [&](vf v) -> vf {
        vi bits_of = (vi)v;
        vi e = (bits_of >> 23) - 127;
        vf f = (vf)((bits_of & 0x7fffff) | 0x3f800000);
        const vi high = f > 1.41421356f;
        f = (high ? 0.5f * f : f) - 1.0f;
        e = high ? e + 1 : e;
        const vf exponent = __builtin_convertvector(e, vf), f2 = f * f;
        vf p = f * 7.0376836292e-2f - 1.1514610310e-1f;
        p = p * f + 1.1676998740e-1f;
        p = p * f - 1.2420140846e-1f;
        p = p * f + 1.4249322787e-1f;
        p = p * f - 1.6668057665e-1f;
        p = p * f + 2.0000714765e-1f;
        p = p * f - 2.4999993993e-1f;
        p = p * f + 3.3333331174e-1f;
        return exponent * 0.693359375f + (f + (p * f * f2 - exponent * 2.12194440e-4f - 0.5f * f2));
    };
    const vf z = point[2];
    vf seen = opacity[0];
    if (antialiased) seen = seen * root(raw_determinant / determinant);
    // A comparison with NaN is false: written as what must hold, the conditions cull it.
    vi visible = (z > 0.0f) & (z >= near_plane) & (z <= far_plane) & (seen >= ALPHA_MIN) & finite(seen);
    visible = visible & (determinant > 0.0f) & (inverse_norm > 0.0f);
    const vf ratio = visible ? seen / ALPHA_MIN : ONE;
    const vf logarithms = logarithm(ratio);
    const vf extent = root(2.0f * (logarithms > 0.0f ? logarithms : ZERO));
    auto radius = [&](vf variance) -> vf {
        const vf r = __builtin_elementwise_ceil(extent * root(visible ? variance : ONE));
        return r < RADIUS_MAX ? r : ZERO + RADIUS_MAX;
    };
    const vf radius_x = radius(xx), radius_y = radius(yy);
    vf conic[3] = {yy / determinant, -xy / determinant, xx / determinant};
    vf mean2d[2] = {scale_x * point[0] + cx, scale_y * point[1] + cy};
    visible = visible & ((radius_x > radius_clip) | (radius_y > radius_clip)) & (radius_x > 0.0f) & (radius_y > 0.0f);
    visible = visible & (mean2d[0] + radius_x > 0.0f) & (mean2d[0] - radius_x < w);
    visible = visible & (mean2d[1] + radius_y > 0.0f) & (mean2d[1] - radius_y < h);
    visible = visible & finite(conic[0] + conic[2] + xx + yy) & finite(conic[1]);
    visible = visible & finite(mean2d[0]) & finite(mean2d[1]) & finite(z);
    for (int c = 0; c < 3; ++c) conic[c] = visible ? conic[c] : ZERO;
    for (int c = 0; c < 2; ++c) mean2d[c] = visible ? mean2d[c] : ZERO;
    const vf depth[1] = {visible ? z : ZERO}, out_opacity[1] = {visible ? seen : ZERO};
    const vi radii_xy[2] = {__builtin_convertvector(visible ? radius_x : ZERO, vi),
        __builtin_convertvector(visible ? radius_y : ZERO, vi)};
    scatter((float*)means2d.data, mean2d, Two());
    scatter((float*)conics.data, conic, Three());
    scatter(depths.data, depth, One());
    scatter(opacities_out.data, out_opacity, One());
    scatter((float*)radii.data, (const vf*)radii_xy, Two());
#endif
"""
)

_ADJOINT = (
    _PRELUDE
    + """
    vf box[2], v_mean2d[2], v_conic[3], v_depth[1] = {ZERO}, v_seen[1];
    gather((const float*)radii.data, box, Two());
    gather((const float*)v_means2d.data, v_mean2d, Two());
    gather((const float*)v_conics.data, v_conic, Three());
    if (v_depths.data) gather(v_depths.data, v_depth, One());
    gather(v_opacities.data, v_seen, One());
    const vi visible = (vi)box[0] > 0;

    // d(inverse) = - inverse d(covariance) inverse
    const vf a = yy / determinant, b = -xy / determinant, c = xx / determinant;
    vf v_xx = -(a * a * v_conic[0] + a * b * v_conic[1] + b * b * v_conic[2]);
    vf v_xy = -(2.0f * a * b * v_conic[0] + (a * c + b * b) * v_conic[1] + 2.0f * b * c * v_conic[2]);
    vf v_yy = -(b * b * v_conic[0] + b * c * v_conic[1] + c * c * v_conic[2]);
    vf v_opacity = v_seen[0];
    if (antialiased) {
        const vf ratio = raw_determinant / determinant, factor = root(ratio);
        v_opacity = factor * v_seen[0];
        const vf half = 0.5f * opacity[0] * v_seen[0] / (factor * determinant);
        v_xx += half * (raw_yy - ratio * yy);
        v_yy += half * (raw_xx - ratio * xx);
        v_xy += half * (-2.0f * xy * (1.0f - ratio));
    }
    vf v_row_x[3], v_row_y[3], v_scaled[3][3], v_axes[3][3], v_scale[3];
    for (int k = 0; k < 3; ++k) {
        v_row_x[k] = 2.0f * v_xx * row_x[k] + v_xy * row_y[k];
        v_row_y[k] = 2.0f * v_yy * row_y[k] + v_xy * row_x[k];
        // rows = scale (axis - slope forward), with the Gaussian's scales inside axis and forward
        v_scaled[0][k] = scale_x * v_row_x[k];
        v_scaled[1][k] = scale_y * v_row_y[k];
        v_scaled[2][k] = -slope_x * v_scaled[0][k] - slope_y * v_scaled[1][k];
        v_scale[k] = v_scaled[0][k] * axes[0][k] + v_scaled[1][k] * axes[1][k] + v_scaled[2][k] * axes[2][k];
        for (int r = 0; r < 3; ++r) v_axes[r][k] = v_scaled[r][k] * scale[k];
    }
    vf v[3][3];  // of the rotation of the Gaussian
    for (int r = 0; r < 3; ++r)
        for (int k = 0; k < 3; ++k)
            v[r][k] = view[r] * v_axes[0][k] + view[4 + r] * v_axes[1][k] + view[8 + r] * v_axes[2][k];
    const vf v_unit[4] = {
        2.0f * (qx * (v[2][1] - v[1][2]) + qy * (v[0][2] - v[2][0]) + qz * (v[1][0] - v[0][1])),
        2.0f * (-2.0f * qx * (v[1][1] + v[2][2]) + qy * (v[1][0] + v[0][1]) + qz * (v[2][0] + v[0][2])
            + qw * (v[2][1] - v[1][2])),
        2.0f * (qx * (v[1][0] + v[0][1]) - 2.0f * qy * (v[0][0] + v[2][2]) + qz * (v[2][1] + v[1][2])
            + qw * (v[0][2] - v[2][0])),
        2.0f * (qx * (v[2][0] + v[0][2]) + qy * (v[2][1] + v[1][2]) - 2.0f * qz * (v[0][0] + v[1][1])
            + qw * (v[1][0] - v[0][1]))};
    const vf along = unit[0] * v_unit[0] + unit[1] * v_unit[1] + unit[2] * v_unit[2] + unit[3] * v_unit[3];
    vf v_quat[4];
    for (int k = 0; k < 4; ++k) v_quat[k] = inverse_norm * (v_unit[k] - along * unit[k]);

    // slope = point.xy / z (clamped), scale = f / z, mean2d = scale point.xy + centre
    const vf v_slope_x = slope_x == raw_slope_x ? -dot(v_scaled[0], deep) : ZERO;
    const vf v_slope_y = slope_y == raw_slope_y ? -dot(v_scaled[1], deep) : ZERO;
    const vf v_x = v_mean2d[0] * scale_x + v_slope_x * near, v_y = v_mean2d[1] * scale_y + v_slope_y * near;
    // Every term but depth falls with 1 / z. (row / scale) scale' = -row / z.
    const vf v_z = v_depth[0] - near * (v_x * point[0] + v_y * point[1] + dot(v_row_x, row_x) + dot(v_row_y, row_y));
    vf v_mean[3];
    for (int k = 0; k < 3; ++k) v_mean[k] = view[k] * v_x + view[4 + k] * v_y + view[8 + k] * v_z;
    // Where usable gradients become others (an overflow), none is passed; what came in as NaN goes out as NaN.
    auto usable = [&](vf v) -> vi { return __builtin_elementwise_abs(v) <= GRADIENT_MAX; };
    vi given = usable(v_mean2d[0]) & usable(v_mean2d[1]) & usable(v_depth[0]) & usable(v_seen[0]);
    vi made = usable(v_opacity);
    for (int k = 0; k < 3; ++k) {
        given &= usable(v_conic[k]);
        made &= usable(v_mean[k]) & usable(v_scale[k]);
    }
    for (int k = 0; k < 4; ++k) made &= usable(v_quat[k]);
    const vi passes = visible & (made | ~given);
    const vf v_opacity_in[1] = {passes ? v_opacity : ZERO};
    for (int k = 0; k < 3; ++k) {
        v_mean[k] = passes ? v_mean[k] : ZERO;
        v_scale[k] = passes ? v_scale[k] : ZERO;
    }
    for (int k = 0; k < 4; ++k) v_quat[k] = passes ? v_quat[k] : ZERO;
    scatter((float*)v_means.data, v_mean, Three());
    scatter((float*)v_quats.data, v_quat, Four());
    scatter((float*)v_scales.data, v_scale, Three());
    scatter(v_opacities_out.data, v_opacity_in, One());
#endif
"""
)


# fmt: off
@wp.func_native(_FORWARD)
def _project(
    begin: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], scales: wp.array[wp.vec3],
    opacities: wp.array[float], viewmat: wp.array[wp.mat44], intrinsics: wp.array[wp.mat33], width: int, height: int,
    near_plane: float, far_plane: float, radius_clip: float, eps2d: float, antialiased: int,
    means2d: wp.array[wp.vec2], conics: wp.array[wp.vec3], depths: wp.array[float], opacities_out: wp.array[float],
    radii: wp.array[wp.vec2i],
): ...


@wp.func_native(_ADJOINT)
def _project_adjoint(
    begin: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], scales: wp.array[wp.vec3],
    opacities: wp.array[float], viewmat: wp.array[wp.mat44], intrinsics: wp.array[wp.mat33], width: int, height: int,
    eps2d: float, antialiased: int, radii: wp.array[wp.vec2i], v_means2d: wp.array[wp.vec2],
    v_conics: wp.array[wp.vec3], v_depths: wp.array[float], v_opacities: wp.array[float], v_means: wp.array[wp.vec3],
    v_quats: wp.array[wp.vec4], v_scales: wp.array[wp.vec3], v_opacities_out: wp.array[float],
): ...
# fmt: on


@wp.kernel
def project_lanes(
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
    # Out: (all zero where culled)
    means2d_out: wp.array[wp.vec2],  # [N]
    conics_out: wp.array[wp.vec3],  # [N]
    depths_out: wp.array[float],  # [N]
    opacities_out: wp.array[float],  # [N]
    radii_out: wp.array[wp.vec2i],  # [N]
):
    """Gaussians ``16 i .. 16 i + 15``."""
    _project(
        (first + wp.tid()) * LANES, means_in, quats_in, scales_in, opacities_in, viewmat_in, K_in, width, height,
        near_plane, far_plane, radius_clip, eps2d, antialiased, means2d_out, conics_out, depths_out, opacities_out,
        radii_out,
    )  # fmt: skip


@wp.kernel
def project_lanes_adjoint(
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
    # Out:
    v_means_out: wp.array[wp.vec3],  # [N]
    v_quats_out: wp.array[wp.vec4],  # [N]
    v_scales_out: wp.array[wp.vec3],  # [N]
    v_opacities_out: wp.array[float],  # [N]
):
    """Gaussians ``16 i .. 16 i + 15``. The camera's gradient is left to ``projection.project_adjoint``."""
    _project_adjoint(
        (first + wp.tid()) * LANES, means_in, quats_in, scales_in, opacities_in, viewmat_in, K_in, width, height,
        eps2d, antialiased, radii_in, v_means2d_in, v_conics_in, v_depths_in, v_opacities_in, v_means_out, v_quats_out,
        v_scales_out, v_opacities_out,
    )  # fmt: skip
