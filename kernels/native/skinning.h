// Skinning of 16 Gaussians, one per lane, by the formulas of kernels/skinning.py.
#pragma once
#include "exponential.h"
#include "skinning_block.h"

// Gaussians that were moved: positions, unit quaternions, and the blends of the extras, if there are any.
struct Moved {
    vf mean[3], quat[4], extra[3];

    // Write them; `extras` is touched only with has_extras.
    __attribute__((always_inline)) void write(
        int begin, int rows, int has_extras, wp::array_t<wp::vec3>& means_t, wp::array_t<wp::vec4>& quats_t,
        wp::array_t<wp::vec3>& extras
    ) const {
        write_vectors(means_t.data, begin, rows, 3, mean);
        write_vectors(quats_t.data, begin, rows, 4, quat);
        if (has_extras) write_vectors(extras.data, begin, rows, 3, extra);
    }
};

// Move the Gaussians at x and q by their blended motion.
ALWAYS_INLINE Moved moved_by(
    const vf* x, const vf* q, const wp::array_t<float>& motion, const wp::array_t<float>& reach, const int* pick, int K,
    const float* weight, const vf* weights_of, int aligned, int has_extras
) {
    FUSE_WITHIN_EXPRESSIONS
    Moved to;
    vf B[16], side[MAX_NEIGHBORS], b[4], u[4];
    blend(motion.data, pick, weight, weights_of, K, aligned, side, B);
    for (int c = 0; c < 3; ++c) to.mean[c] = B[4 * c] * x[0] + B[4 * c + 1] * x[1] + B[4 * c + 2] * x[2] + B[4 * c + 3];
    vf nb = inverse_norm(B[12], B[13], B[14], B[15]), nq = inverse_norm(q[0], q[1], q[2], q[3]);
    normalise(B + 12, nb, b);
    normalise(q, nq, u);
    to.quat[0] = b[0] * u[0] - b[1] * u[1] - b[2] * u[2] - b[3] * u[3];
    to.quat[1] = b[0] * u[1] + b[1] * u[0] + b[2] * u[3] - b[3] * u[2];
    to.quat[2] = b[0] * u[2] - b[1] * u[3] + b[2] * u[0] + b[3] * u[1];
    to.quat[3] = b[0] * u[3] + b[1] * u[2] - b[2] * u[1] + b[3] * u[0];
    if (has_extras) {
        float sums[16][4];
        vf a[4], columns[4];
        for (int l = 0; l < 16; ++l) {
            v4 row = {};
            for (int k = 0; k < K; ++k)
                row = row + weight[l * K + k] * *(const v4*)(reach.data + 16ll * pick[l * K + k] + 4);
            *(v4*)sums[l] = row;
        }
        for (int i = 0; i < 4; ++i) a[i] = load16(sums[4 * i]);
        split4(a, columns);
        for (int c = 0; c < 3; ++c) to.extra[c] = columns[1 + c];
    }
    return to;
}

// Skin with known weights.
static inline void skin(
    int begin, const wp::array_t<wp::vec3>& means, const wp::array_t<wp::vec4>& quats, const wp::array_t<float>& motion,
    const wp::array_t<float>& reach, int aligned, int has_extras, const wp::array_t<int>& indices,
    const wp::array_t<float>& weights, wp::array_t<wp::vec3>& means_t, wp::array_t<wp::vec4>& quats_t,
    wp::array_t<wp::vec3>& extras
) {
    FUSE_WITHIN_EXPRESSIONS
    auto run = [&](auto kc) __attribute__((always_inline)) {
        const int K = decltype(kc)::value ? decltype(kc)::value : indices.shape[1];
        const int rows = means.shape[0] - begin < 16 ? means.shape[0] - begin : 16;
        vf x[3], q[4];
        int spare_picks[16 * MAX_NEIGHBORS];
        float spare_weights[16 * MAX_NEIGHBORS];
        read_vectors(means.data, begin, rows, 3, x);
        read_vectors(quats.data, begin, rows, 4, q);
        const int* pick = (const int*)read_rows(indices.data + (long long)begin * K, rows, 4 * K, spare_picks);
        const float* weight = (const float*)read_rows(weights.data + (long long)begin * K, rows, 4 * K, spare_weights);
        vf columns[16];
        if (!aligned) weight_columns(weight, K, columns);
        const Moved to = moved_by(x, q, motion, reach, pick, K, weight, columns, aligned, has_extras);
        to.write(begin, rows, has_extras, means_t, quats_t, extras);
    };
    by_count()(indices.shape[1], run);
}

// Compute RBF weights, write them, and skin with them.
static inline void skin_rbf(
    int begin, const wp::array_t<wp::vec3>& means, const wp::array_t<wp::vec4>& quats, const wp::array_t<float>& hyper,
    int has_hyper, const wp::array_t<float>& motion, const wp::array_t<float>& reach, int aligned, int has_strengths,
    int has_extras, const wp::array_t<int>& indices, wp::array_t<float>& weights, wp::array_t<wp::vec3>& means_t,
    wp::array_t<wp::vec4>& quats_t, wp::array_t<wp::vec3>& extras
) {
    FUSE_WITHIN_EXPRESSIONS
    const int H = has_hyper ? hyper.shape[1] : 0;
    const float infinity = __builtin_inff();
    auto run = [&](auto kc) __attribute__((always_inline)) {
        const int K = decltype(kc)::value ? decltype(kc)::value : indices.shape[1];
        const int rows = means.shape[0] - begin < 16 ? means.shape[0] - begin : 16;
        vf x[3], q[4];
        int spare_picks[16 * MAX_NEIGHBORS];
        float spare_weights[16 * MAX_NEIGHBORS];
        read_vectors(means.data, begin, rows, 3, x);
        read_vectors(quats.data, begin, rows, 4, q);
        const int* pick = (const int*)read_rows(indices.data + (long long)begin * K, rows, 4 * K, spare_picks);
        vf hyper_point[MAX_HYPER];
        read_hyper(hyper, H, begin, rows, hyper_point);
        vf w[MAX_NEIGHBORS], top = vf{} - infinity, total = vf{};
        for (int k = 0; k < K; ++k) {
            vf e[4 + MAX_HYPER];
            vf logit = offset(reach.data, pick, K, k, x, hyper_point, H, e);
            logit = logit * e[3];
            if (has_strengths) {
                float strength[16];
#pragma clang loop vectorize(disable)
                for (int l = 0; l < 16; ++l) strength[l] = reach.data[16ll * pick[l * K + k] + 4];
                logit = logit + load16(strength);
            }
            w[k] = ((logit > -infinity) & (logit < infinity)) ? logit : vf{} - infinity;
            top = w[k] > top ? w[k] : top;
        }
        const vi nothing_near = top == -infinity;
        for (int k = 0; k < K; ++k) {
            w[k] = w[k] > -infinity ? exponential(w[k] - (nothing_near ? vf{} : top)) : vf{};
            if (k == 0) w[k] = nothing_near ? vf{} + 1.0f : w[k];
            total = total + w[k];
        }
        const vf inverse = 1.0f / total;
        for (int k = 0; k < K; ++k) w[k] = w[k] * inverse;
        weight_rows(w, K, spare_weights);
        __builtin_memcpy(weights.data + (long long)begin * K, spare_weights, 4 * K * rows);
        const Moved to = moved_by(x, q, motion, reach, pick, K, spare_weights, w, aligned, has_extras);
        to.write(begin, rows, has_extras, means_t, quats_t, extras);
    };
    by_count()(indices.shape[1], run);
}
