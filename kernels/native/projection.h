// Projection of 16 Gaussians, one per lane, and its adjoint, by the formulas of kernels/projection.py.
#pragma once
#include "simd.h"

// Turn up to 16 rows of C floats into C vectors with a row in each lane; lanes from n on are 0.
ALWAYS_INLINE void gather_rows(const float* from, int n, int C, vf* to) {
    float lanes[4][16] = {};
    for (int l = 0; l < n; ++l)
        for (int c = 0; c < C; ++c) lanes[c][l] = from[C * l + c];
    __builtin_memcpy(to, lanes, 64 * C);
}

ALWAYS_INLINE void scatter_rows(float* to, int n, int C, const vf* from) {
    float lanes[4][16];
    __builtin_memcpy(lanes, from, 64 * C);
    for (int l = 0; l < n; ++l)
        for (int c = 0; c < C; ++c) to[C * l + c] = lanes[c][l];
}

static inline vf root(vf v) { return __builtin_elementwise_sqrt(v); }
static inline vi usable(vf v) { return __builtin_elementwise_abs(v) <= GRADIENT_MAX; }

static inline vf clamp(vf v, float low, float high) {
    v = v < low ? vf{} + low : v;
    return v > high ? vf{} + high : v;
}

static inline vf dot(const vf* a, const vf* b) {
    FUSE_WITHIN_EXPRESSIONS
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// Natural logarithm of v >= 1: v = 2^e f with f in [sqrt(1/2), sqrt(2)), and a polynomial in f - 1 (error 1e-7).
static inline vf logarithm(vf v) {
    FUSE_WITHIN_EXPRESSIONS
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
}

// 16 Gaussians in front of the camera. "Raw" variances are those before eps2d is added to them.
struct Footprints {
    int n;                           // Gaussians in use; lanes from n on are zero
    const float* view;               // world-to-camera, rows of 4
    float w, h;                      // image size
    float cx, cy;                    // principal point
    vf scale[3], opacity;            // of the Gaussians
    vf point[3], inverse_z;          // means in the camera's frame
    vf unit[4], inverse_norm;        // quaternions
    vf axes[3][3];                   // rotations from the Gaussians to the camera
    vf raw_slope_x, raw_slope_y;     // x / z and y / z
    vf slope_x, slope_y;             // the same, clamped to the widened frustum
    vf scale_x, scale_y;             // pixels per unit at this depth
    vf deep[3], row_x[3], row_y[3];  // rows of the Gaussians' scaled axes: depth, and both of the Jacobian times axes
    vf raw_xx, raw_yy, raw_determinant;  // covariances
    vf xx, xy, yy, determinant;
};

static inline Footprints footprints_of(
    int begin, const wp::array_t<wp::vec3>& means, const wp::array_t<wp::vec4>& quats,
    const wp::array_t<wp::vec3>& scales, const wp::array_t<float>& opacities, const wp::array_t<wp::mat44>& viewmat,
    const wp::array_t<wp::mat33>& intrinsics, int width, int height, float eps2d
) {
    FUSE_WITHIN_EXPRESSIONS
    const vf ZERO = {};
    Footprints f;
    f.n = means.shape.dims[0] - begin < 16 ? means.shape.dims[0] - begin : 16;
    f.view = (const float*)viewmat.data;
    const float* K = (const float*)intrinsics.data;
    const float fx = K[0], fy = K[4];
    f.cx = K[2];
    f.cy = K[5];
    f.w = (float)width;
    f.h = (float)height;
    vf mean[3], quat[4];
    gather_rows((const float*)(means.data + begin), f.n, 3, mean);
    gather_rows((const float*)(quats.data + begin), f.n, 4, quat);
    gather_rows((const float*)(scales.data + begin), f.n, 3, f.scale);
    gather_rows(opacities.data + begin, f.n, 1, &f.opacity);

    for (int r = 0; r < 3; ++r)
        f.point[r] =
            f.view[4 * r] * mean[0] + f.view[4 * r + 1] * mean[1] + f.view[4 * r + 2] * mean[2] + f.view[4 * r + 3];
    f.inverse_z = 1.0f / f.point[2];
    const vf squared = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
    f.inverse_norm = squared > 0.0f ? 1.0f / root(squared) : ZERO;
    for (int c = 0; c < 4; ++c)
        f.unit[c] = f.inverse_norm > 0.0f ? f.inverse_norm * quat[c] : ZERO + (c == 0 ? 1.0f : 0.0f);
    const vf &qw = f.unit[0], &qx = f.unit[1], &qy = f.unit[2], &qz = f.unit[3];
    const vf rotation[3][3] = {
        {1.0f - 2.0f * (qy * qy + qz * qz), 2.0f * (qx * qy - qw * qz), 2.0f * (qx * qz + qw * qy)},
        {2.0f * (qx * qy + qw * qz), 1.0f - 2.0f * (qx * qx + qz * qz), 2.0f * (qy * qz - qw * qx)},
        {2.0f * (qx * qz - qw * qy), 2.0f * (qy * qz + qw * qx), 1.0f - 2.0f * (qx * qx + qy * qy)}
    };
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c)
            f.axes[r][c] = f.view[4 * r] * rotation[0][c] + f.view[4 * r + 1] * rotation[1][c] +
                           f.view[4 * r + 2] * rotation[2][c];
    f.raw_slope_x = f.inverse_z * f.point[0];
    f.raw_slope_y = f.inverse_z * f.point[1];
    const float margin_x = FRUSTUM_MARGIN * 0.5f * f.w / fx, margin_y = FRUSTUM_MARGIN * 0.5f * f.h / fy;
    f.slope_x = clamp(f.raw_slope_x, -f.cx / fx - margin_x, (f.w - f.cx) / fx + margin_x);
    f.slope_y = clamp(f.raw_slope_y, -f.cy / fy - margin_y, (f.h - f.cy) / fy + margin_y);
    f.scale_x = f.inverse_z * fx;
    f.scale_y = f.inverse_z * fy;
    for (int c = 0; c < 3; ++c) {
        f.deep[c] = f.axes[2][c] * f.scale[c];
        f.row_x[c] = f.scale_x * (f.axes[0][c] * f.scale[c] - f.slope_x * f.deep[c]);
        f.row_y[c] = f.scale_y * (f.axes[1][c] * f.scale[c] - f.slope_y * f.deep[c]);
    }
    f.raw_xx = dot(f.row_x, f.row_x);
    f.raw_yy = dot(f.row_y, f.row_y);
    f.xy = dot(f.row_x, f.row_y);
    const vf normal[3] = {
        f.row_x[1] * f.row_y[2] - f.row_x[2] * f.row_y[1], f.row_x[2] * f.row_y[0] - f.row_x[0] * f.row_y[2],
        f.row_x[0] * f.row_y[1] - f.row_x[1] * f.row_y[0]
    };
    f.raw_determinant = dot(normal, normal);
    f.xx = f.raw_xx + eps2d;
    f.yy = f.raw_yy + eps2d;
    f.determinant = f.raw_determinant + eps2d * (f.raw_xx + f.raw_yy + eps2d);
    return f;
}

static inline void project(
    int begin, const wp::array_t<wp::vec3>& means, const wp::array_t<wp::vec4>& quats,
    const wp::array_t<wp::vec3>& scales, const wp::array_t<float>& opacities, const wp::array_t<wp::mat44>& viewmat,
    const wp::array_t<wp::mat33>& intrinsics, int width, int height, float near_plane, float far_plane,
    float radius_clip, float eps2d, int antialiased, float sharpness, wp::array_t<wp::vec2>& means2d,
    wp::array_t<wp::vec3>& conics, wp::array_t<float>& depths, wp::array_t<float>& opacities_out,
    wp::array_t<wp::vec2i>& radii
) {
    FUSE_WITHIN_EXPRESSIONS
    const vf ZERO = {}, ONE = ZERO + 1.0f;
    const Footprints f =
        footprints_of(begin, means, quats, scales, opacities, viewmat, intrinsics, width, height, eps2d);
    const vf z = f.point[2];
    vf seen = f.opacity;
    if (antialiased) seen = seen * root(f.raw_determinant / f.determinant);
    // Comparisons with NaN are false. Each condition states what must hold, so that NaN is culled.
    vi visible = (z > 0.0f) & (z >= near_plane) & (z <= far_plane) & (seen >= ALPHA_MIN) & finite(seen);
    visible = visible & (f.determinant > 0.0f) & (f.inverse_norm > 0.0f);
    const vf ratio = visible ? seen / ALPHA_MIN : ONE;
    const vf logarithms = logarithm(ratio);
    const vf reach = logarithms > 0.0f ? logarithms : ZERO;
    const vf extent = root(4.0f * reach / (1.0f + root(1.0f + 4.0f * sharpness * reach)));
    auto radius = [&](vf variance) -> vf {
        const vf r = __builtin_elementwise_ceil(extent * root(visible ? variance : ONE));
        return r < RADIUS_MAX ? r : ZERO + RADIUS_MAX;
    };
    const vf radius_x = radius(f.xx), radius_y = radius(f.yy);
    vf conic[3] = {f.yy / f.determinant, -f.xy / f.determinant, f.xx / f.determinant};
    vf mean2d[2] = {f.scale_x * f.point[0] + f.cx, f.scale_y * f.point[1] + f.cy};
    visible = visible & ((radius_x > radius_clip) | (radius_y > radius_clip)) & (radius_x > 0.0f) & (radius_y > 0.0f);
    visible = visible & (mean2d[0] + radius_x > 0.0f) & (mean2d[0] - radius_x < f.w);
    visible = visible & (mean2d[1] + radius_y > 0.0f) & (mean2d[1] - radius_y < f.h);
    visible = visible & finite(conic[0] + conic[2] + f.xx + f.yy) & finite(conic[1]);
    visible = visible & finite(mean2d[0]) & finite(mean2d[1]) & finite(z);
    for (int c = 0; c < 3; ++c) conic[c] = visible ? conic[c] : ZERO;
    for (int c = 0; c < 2; ++c) mean2d[c] = visible ? mean2d[c] : ZERO;
    const vf depth[1] = {visible ? z : ZERO}, out_opacity[1] = {visible ? seen : ZERO};
    const vi radii_xy[2] = {
        __builtin_convertvector(visible ? radius_x : ZERO, vi), __builtin_convertvector(visible ? radius_y : ZERO, vi)
    };
    scatter_rows((float*)(means2d.data + begin), f.n, 2, mean2d);
    scatter_rows((float*)(conics.data + begin), f.n, 3, conic);
    scatter_rows(depths.data + begin, f.n, 1, depth);
    scatter_rows(opacities_out.data + begin, f.n, 1, out_opacity);
    scatter_rows((float*)(radii.data + begin), f.n, 2, (const vf*)radii_xy);
}

static inline void project_adjoint(
    int begin, const wp::array_t<wp::vec3>& means, const wp::array_t<wp::vec4>& quats,
    const wp::array_t<wp::vec3>& scales, const wp::array_t<float>& opacities, const wp::array_t<wp::mat44>& viewmat,
    const wp::array_t<wp::mat33>& intrinsics, int width, int height, float eps2d, int antialiased,
    const wp::array_t<wp::vec2i>& radii, const wp::array_t<wp::vec2>& v_means2d, const wp::array_t<wp::vec3>& v_conics,
    const wp::array_t<float>& v_depths, const wp::array_t<float>& v_opacities, wp::array_t<wp::vec3>& v_means,
    wp::array_t<wp::vec4>& v_quats, wp::array_t<wp::vec3>& v_scales, wp::array_t<float>& v_opacities_out
) {
    FUSE_WITHIN_EXPRESSIONS
    const vf ZERO = {};
    const Footprints f =
        footprints_of(begin, means, quats, scales, opacities, viewmat, intrinsics, width, height, eps2d);
    vf box[2], v_mean2d[2], v_conic[3], v_depth[1] = {ZERO}, v_seen[1];
    gather_rows((const float*)(radii.data + begin), f.n, 2, box);
    gather_rows((const float*)(v_means2d.data + begin), f.n, 2, v_mean2d);
    gather_rows((const float*)(v_conics.data + begin), f.n, 3, v_conic);
    if (v_depths.data) gather_rows(v_depths.data + begin, f.n, 1, v_depth);
    gather_rows(v_opacities.data + begin, f.n, 1, v_seen);
    const vi visible = (vi)box[0] > 0;

    // d(inverse) = - inverse d(covariance) inverse
    const vf a = f.yy / f.determinant, b = -f.xy / f.determinant, c = f.xx / f.determinant;
    vf v_xx = -(a * a * v_conic[0] + a * b * v_conic[1] + b * b * v_conic[2]);
    vf v_xy = -(2.0f * a * b * v_conic[0] + (a * c + b * b) * v_conic[1] + 2.0f * b * c * v_conic[2]);
    vf v_yy = -(b * b * v_conic[0] + b * c * v_conic[1] + c * c * v_conic[2]);
    vf v_opacity = v_seen[0];
    if (antialiased) {
        const vf ratio = f.raw_determinant / f.determinant, factor = root(ratio);
        v_opacity = factor * v_seen[0];
        const vf half = 0.5f * f.opacity * v_seen[0] / (factor * f.determinant);
        v_xx += half * (f.raw_yy - ratio * f.yy);
        v_yy += half * (f.raw_xx - ratio * f.xx);
        v_xy += half * (-2.0f * f.xy * (1.0f - ratio));
    }
    vf v_row_x[3], v_row_y[3], v_scaled[3][3], v_axes[3][3], v_scale[3];
    for (int k = 0; k < 3; ++k) {
        v_row_x[k] = 2.0f * v_xx * f.row_x[k] + v_xy * f.row_y[k];
        v_row_y[k] = 2.0f * v_yy * f.row_y[k] + v_xy * f.row_x[k];
        // rows = scale (axis - slope forward), with the Gaussian's scales inside axis and forward
        v_scaled[0][k] = f.scale_x * v_row_x[k];
        v_scaled[1][k] = f.scale_y * v_row_y[k];
        v_scaled[2][k] = -f.slope_x * v_scaled[0][k] - f.slope_y * v_scaled[1][k];
        v_scale[k] = v_scaled[0][k] * f.axes[0][k] + v_scaled[1][k] * f.axes[1][k] + v_scaled[2][k] * f.axes[2][k];
        for (int r = 0; r < 3; ++r) v_axes[r][k] = v_scaled[r][k] * f.scale[k];
    }
    const vf &qw = f.unit[0], &qx = f.unit[1], &qy = f.unit[2], &qz = f.unit[3];
    vf v[3][3];  // gradient to the Gaussian's rotation
    for (int r = 0; r < 3; ++r)
        for (int k = 0; k < 3; ++k)
            v[r][k] = f.view[r] * v_axes[0][k] + f.view[4 + r] * v_axes[1][k] + f.view[8 + r] * v_axes[2][k];
    const vf v_unit[4] = {
        2.0f * (qx * (v[2][1] - v[1][2]) + qy * (v[0][2] - v[2][0]) + qz * (v[1][0] - v[0][1])),
        2.0f * (-2.0f * qx * (v[1][1] + v[2][2]) + qy * (v[1][0] + v[0][1]) + qz * (v[2][0] + v[0][2]) +
                qw * (v[2][1] - v[1][2])),
        2.0f * (qx * (v[1][0] + v[0][1]) - 2.0f * qy * (v[0][0] + v[2][2]) + qz * (v[2][1] + v[1][2]) +
                qw * (v[0][2] - v[2][0])),
        2.0f * (qx * (v[2][0] + v[0][2]) + qy * (v[2][1] + v[1][2]) - 2.0f * qz * (v[0][0] + v[1][1]) +
                qw * (v[1][0] - v[0][1]))
    };
    const vf along = f.unit[0] * v_unit[0] + f.unit[1] * v_unit[1] + f.unit[2] * v_unit[2] + f.unit[3] * v_unit[3];
    vf v_quat[4];
    for (int k = 0; k < 4; ++k) v_quat[k] = f.inverse_norm * (v_unit[k] - along * f.unit[k]);

    // slope = point.xy / z (clamped), scale = f / z, mean2d = scale point.xy + centre
    const vf v_slope_x = f.slope_x == f.raw_slope_x ? -dot(v_scaled[0], f.deep) : ZERO;
    const vf v_slope_y = f.slope_y == f.raw_slope_y ? -dot(v_scaled[1], f.deep) : ZERO;
    const vf v_x = v_mean2d[0] * f.scale_x + v_slope_x * f.inverse_z,
             v_y = v_mean2d[1] * f.scale_y + v_slope_y * f.inverse_z;
    // Every term but depth falls with 1 / z. (row / scale) scale' = -row / z.
    const vf v_z = v_depth[0] -
                   f.inverse_z * (v_x * f.point[0] + v_y * f.point[1] + dot(v_row_x, f.row_x) + dot(v_row_y, f.row_y));
    vf v_mean[3];
    for (int k = 0; k < 3; ++k) v_mean[k] = f.view[k] * v_x + f.view[4 + k] * v_y + f.view[8 + k] * v_z;
    // If usable incoming gradients overflow here, pass zeros; an incoming NaN stays NaN.
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
    scatter_rows((float*)(v_means.data + begin), f.n, 3, v_mean);
    scatter_rows((float*)(v_quats.data + begin), f.n, 4, v_quat);
    scatter_rows((float*)(v_scales.data + begin), f.n, 3, v_scale);
    scatter_rows(v_opacities_out.data + begin, f.n, 1, v_opacity_in);
}
