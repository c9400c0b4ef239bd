// Colours from spherical harmonics of 16 Gaussians, and their adjoint.
//
// A Gaussian's 45 coefficients are 15 triples of red, green, blue. They are processed in vectors of 15 (the 16th lane
// is unused), so that a lane always belongs to the same channel. The basis is computed with one Gaussian per lane and
// then transposed, so that each Gaussian's basis is one vector.
#pragma once
#include "shuffles.h"
#include "simd.h"

// View directions and basis values of Gaussians ``begin`` to ``begin + 15``; lanes past the end are zero.
struct Basis {
    int begin, total, n;
    int used;        // number of floats of a Gaussian's coefficients that are used
    int row;         // number of floats of a Gaussian's coefficients
    long long size;  // number of floats of all coefficients
    const float* coefficients;
    vf inverse, x, y, z, xx, yy, zz, value[16];

    Basis(
        int begin, const wp::array_t<wp::vec_t<3, float>>& sh_rest, int rest,
        const wp::array_t<wp::vec_t<3, float>>& means, const wp::array_t<wp::vec_t<3, float>>& camera, int degree
    )
        : begin(begin) {
        FUSE_WITHIN_EXPRESSIONS
        const vf ZERO = {};
        total = means.shape.dims[0];
        n = total - begin < 16 ? total - begin : 16;
        used = degree == 0 ? 0 : degree == 1 ? 9 : degree == 2 ? 24 : 45;
        row = 3 * rest;
        size = (long long)total * row;
        coefficients = (const float*)sh_rest.data;
        vf mean[3];
        read(means.data, mean);
        const vf ox = mean[0] - camera.data[0][0], oy = mean[1] - camera.data[0][1], oz = mean[2] - camera.data[0][2];
        const vf squared = ox * ox + oy * oy + oz * oz;
        inverse = ((squared > 0.0f) & (squared < __builtin_inff())) ? 1.0f / __builtin_elementwise_sqrt(squared) : ZERO;
        const vi seen = inverse > 0.0f;
        x = seen ? inverse * ox : ZERO;
        y = seen ? inverse * oy : ZERO;
        z = seen ? inverse * oz : ZERO;
        xx = x * x;
        yy = y * y;
        zz = z * z;
        value[0] = -SH_C1 * y;
        value[1] = SH_C1 * z;
        value[2] = -SH_C1 * x;
        value[3] = SH_C2 * x * y;
        value[4] = -SH_C2 * y * z;
        value[5] = SH_C20 * (3.0f * zz - 1.0f);
        value[6] = -SH_C2 * x * z;
        value[7] = SH_C22 * (xx - yy);
        value[8] = SH_C33 * y * (yy - 3.0f * xx);
        value[9] = SH_C32 * x * y * z;
        value[10] = SH_C31 * y * (1.0f - 5.0f * zz);
        value[11] = SH_C30 * z * (5.0f * zz - 3.0f);
        value[12] = SH_C31 * x * (1.0f - 5.0f * zz);
        value[13] = SH_C3Z * z * (xx - yy);
        value[14] = SH_C33 * x * (3.0f * yy - xx);
        value[15] = ZERO;
    }

    // Read the block's rows of three floats as columns.
    __attribute__((always_inline)) void read(const void* data, vf* to) const {
        float spare[48] = {};
        const float* from = (const float*)data + 3ll * begin;
        if (n < 16) {
            __builtin_memcpy(spare, from, 12 * n);
            from = spare;
        }
        const vf a[3] = {load(from, 16), load(from + 16, 16), load(from + 32, 16)};
        split3(a, to);
    }

    // Write three columns as the block's rows.
    __attribute__((always_inline)) void write(void* data, const vf* from) const {
        vf a[3];
        join3(from, a);
        __builtin_memcpy((float*)data + 3ll * begin, a, 12 * n);
    }

    // Return 16 floats of a Gaussian's coefficients, zeros past the array's end.
    __attribute__((always_inline)) vf coefficients_of(int lane, int offset) const {
        const long long at = (long long)(begin + lane) * row + offset;
        const float* from = coefficients + at;
        if (at + 16 <= size) return load(from, 16);
        float spare[16] = {};
        for (int k = 0; at + k < size; ++k) spare[k] = from[k];
        return load(spare, 16);
    }
};

// Factors of the coefficients of basis functions 5 v to 5 v + 4.
ALWAYS_INLINE vf triples(vf b, int v) {
    if (v == 0) return __builtin_shufflevector(b, b, 0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 15);
    if (v == 1) return __builtin_shufflevector(b, b, 5, 5, 5, 6, 6, 6, 7, 7, 7, 8, 8, 8, 9, 9, 9, 15);
    return __builtin_shufflevector(b, b, 10, 10, 10, 11, 11, 11, 12, 12, 12, 13, 13, 13, 14, 14, 14, 15);
}

static inline vi usable(vf v) { return __builtin_elementwise_abs(v) <= GRADIENT_MAX; }

// Compute the colours of a block.
ALWAYS_INLINE void colors_of(const wp::array_t<wp::vec_t<3, float>>& sh_dc, Basis& basis, vf* color) {
    FUSE_WITHIN_EXPRESSIONS
    const vf ZERO = {};
    const vi number = __builtin_convertvector(lane_numbers(), vi);
    vf sums[16];
    basis.read(sh_dc.data, color);
    for (int c = 0; c < 3; ++c) color[c] = SH_C0 * color[c] + 0.5f;
    if (basis.used) {
        transpose(basis.value);
        for (int l = 0; l < 16; ++l) {
            sums[l] = ZERO;
            if (l >= basis.n) continue;
            for (int v = 0; 15 * v < basis.used; ++v) {
                const vf product = triples(basis.value[l], v) * basis.coefficients_of(l, 15 * v);
                sums[l] += number < basis.used - 15 * v ? product : ZERO;
            }
        }
        transpose(sums);
        for (int c = 0; c < 3; ++c) color[c] += sums[c] + sums[3 + c] + sums[6 + c] + sums[9 + c] + sums[12 + c];
    }
    for (int c = 0; c < 3; ++c) color[c] = color[c] > 0.0f ? color[c] : color[c] - color[c];  // 0, or NaN for NaN
}

static inline void harmonics_block(
    int begin, const wp::array_t<wp::vec_t<3, float>>& sh_dc, const wp::array_t<wp::vec_t<3, float>>& sh_rest, int rest,
    const wp::array_t<wp::vec_t<3, float>>& means, const wp::array_t<wp::vec_t<3, float>>& camera, int degree,
    wp::array_t<wp::vec_t<3, float>>& colors
) {
    Basis basis = Basis(begin, sh_rest, rest, means, camera, degree);
    vf color[3];
    colors_of(sh_dc, basis, color);
    basis.write(colors.data, color);
}

// Write colours and depths side by side.
static inline void harmonics_block_with_depth(
    int begin, const wp::array_t<wp::vec_t<3, float>>& sh_dc, const wp::array_t<wp::vec_t<3, float>>& sh_rest, int rest,
    const wp::array_t<wp::vec_t<3, float>>& means, const wp::array_t<wp::vec_t<3, float>>& camera,
    const wp::array_t<float>& depths, int degree, wp::array_t<wp::vec_t<4, float>>& channels
) {
    Basis basis = Basis(begin, sh_rest, rest, means, camera, degree);
    vf row[4], joined[4];
    colors_of(sh_dc, basis, row);
    row[3] = load(depths.data + begin, basis.n);
    join4(row, joined);
    __builtin_memcpy((float*)channels.data + 4ll * begin, joined, 16 * basis.n);
}

static inline void harmonics_block_adjoint(
    int begin, const wp::array_t<wp::vec_t<3, float>>& sh_rest, int rest, const wp::array_t<wp::vec_t<3, float>>& means,
    const wp::array_t<wp::vec_t<3, float>>& camera, int degree, const wp::array_t<wp::vec_t<3, float>>& colors,
    const wp::array_t<wp::vec_t<3, float>>& v_colors, int has_rest, int has_means,
    wp::array_t<wp::vec_t<3, float>>& v_sh_dc, wp::array_t<wp::vec_t<3, float>>& v_sh_rest,
    wp::array_t<wp::vec_t<3, float>>& v_means
) {
    FUSE_WITHIN_EXPRESSIONS
    const vf ZERO = {};
    const vi number = __builtin_convertvector(lane_numbers(), vi);
    const Basis basis = Basis(begin, sh_rest, rest, means, camera, degree);
    const int n = basis.n, used = basis.used, row = basis.row;
    vf color[3], v[16] = {}, v_dc[3], v_mean[3];
    basis.read(colors.data, color);
    basis.read(v_colors.data, v);
    for (int c = 0; c < 3; ++c) {
        v[c] = ((color[c] > 0.0f) & (color[c] < __builtin_inff())) ? v[c] : ZERO;
        v_dc[c] = SH_C0 * v[c];
    }
    basis.write(v_sh_dc.data, v_dc);
    // Coefficients of a culled or clamped Gaussian are not read, so that a NaN among them cannot spread.
    const vi live = (v[0] != 0.0f) | (v[1] != 0.0f) | (v[2] != 0.0f);
    int alive[16];
    __builtin_memcpy(alive, &live, sizeof(alive));
    vf turned[16], products[3][16] = {};
    for (int k = 0; k < 16; ++k) turned[k] = basis.value[k];
    transpose(turned);
    transpose(v);  // row l: the three gradients of Gaussian l
    for (int l = 0; l < n; ++l) {
        const vf channel = __builtin_shufflevector(v[l], v[l], 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 15);
        float* to = has_rest ? (float*)v_sh_rest.data + (long long)(begin + l) * row : nullptr;
        for (int at = 0, k = 0; at < row; at += 15, ++k) {
            const int count = row - at < 15 ? row - at : 15;
            vf value = ZERO;
            if (alive[l] && at < used) {
                value = number < used - at ? triples(turned[l], k) * channel : ZERO;
                if (has_means) products[k][l] = number < used - at ? basis.coefficients_of(l, at) * channel : ZERO;
            }
            if (!has_rest) continue;
            if (count == 15)
                __builtin_memcpy(to + at, &value, 60);
            else
                __builtin_memcpy(to + at, &value, 4 * count);
        }
    }
    if (!has_means) return;
    vf s[15];
    for (int k = 0; k < 3; ++k) {
        if (15 * k < used) transpose(products[k]);
        for (int j = 0; j < 5; ++j) s[5 * k + j] = products[k][3 * j] + products[k][3 * j + 1] + products[k][3 * j + 2];
    }
    const vf &inverse = basis.inverse, &x = basis.x, &y = basis.y, &z = basis.z;
    const vf &xx = basis.xx, &yy = basis.yy, &zz = basis.zz;
    const vf s4 = SH_C2 * s[3], s5 = SH_C2 * s[4], s6 = 6.0f * SH_C20 * s[5], s7 = SH_C2 * s[6];
    const vf s8 = 2.0f * SH_C22 * s[7], s9 = 3.0f * SH_C33 * s[8], s10 = SH_C32 * s[9], s11 = SH_C31 * s[10];
    const vf s12 = 3.0f * SH_C30 * s[11], s13 = SH_C31 * s[12], s14 = SH_C3Z * s[13], s15 = 3.0f * SH_C33 * s[14];
    const vf gx = -SH_C1 * s[2] + s4 * y - s7 * z + s8 * x - 2.0f * s9 * x * y + s10 * y * z +
                  s13 * (1.0f - 5.0f * zz) + 2.0f * s14 * x * z + s15 * (yy - xx);
    const vf gy = -SH_C1 * s[0] + s4 * x - s5 * z - s8 * y + s9 * (yy - xx) + s10 * x * z + s11 * (1.0f - 5.0f * zz) -
                  2.0f * s14 * y * z + 2.0f * s15 * x * y;
    const vf gz = SH_C1 * s[1] + s6 * z - s5 * y - s7 * x + s10 * x * y - 10.0f * z * (s11 * y + s13 * x) +
                  s12 * (5.0f * zz - 1.0f) + s14 * (xx - yy);
    // Only a gradient's component perpendicular to the direction counts, because the direction is normalised.
    const vf along = gx * x + gy * y + gz * z;
    v_mean[0] = live ? inverse * (gx - along * x) : ZERO;
    v_mean[1] = live ? inverse * (gy - along * y) : ZERO;
    v_mean[2] = live ? inverse * (gz - along * z) : ZERO;
    const vi whole = usable(v_mean[0]) & usable(v_mean[1]) & usable(v_mean[2]);  // false if it overflows
    for (int c = 0; c < 3; ++c) v_mean[c] = whole ? v_mean[c] : ZERO;
    basis.write(v_means.data, v_mean);
}
