// Adjoint of skinning with RBF weights, for the blocks of 16 Gaussians of a chunk, one after the other.
#pragma once
#include "lane_sums.h"
#include "skinning_block.h"

ALWAYS_INLINE vi usable(vf v) { return __builtin_elementwise_abs(v) <= GRADIENT_MAX; }
ALWAYS_INLINE vi near(vf v) { return __builtin_elementwise_abs(v) <= POSITION_MAX; }

// Add four columns to the rows of neighbour k; `table` points at the first of the four in node 0's row.
ALWAYS_INLINE void add4(float* table, const int* pick, int K, int k, const vf* columns) {
    FUSE_WITHIN_EXPRESSIONS
    vf parts[4];
    quads(columns, parts);  // quarter l of parts[i]: lane 4 l + i
    float from[64];
    for (int i = 0; i < 4; ++i) store(from + 16 * i, parts[i], 16);
    for (int l = 0; l < 16; ++l) {
        float* sum = table + 16ll * pick[l * K + k];
        *(v4*)sum = *(const v4*)sum + *(const v4*)(from + 16 * (l % 4) + 4 * (l / 4));
    }
}

static inline void skin_rbf_adjoint(
    int chunk, int size, const wp::array_t<wp::vec3>& means, const wp::array_t<wp::vec4>& quats,
    const wp::array_t<float>& hyper, int has_hyper, const wp::array_t<float>& motion, const wp::array_t<float>& reach,
    int aligned, int has_strengths, int has_extras, const wp::array_t<int>& indices, const wp::array_t<float>& weights,
    const wp::array_t<wp::vec3>& v_means_t, const wp::array_t<wp::vec4>& v_quats_t,
    const wp::array_t<wp::vec3>& v_extras_t, wp::array_t<wp::vec3>& v_means, wp::array_t<wp::vec4>& v_quats,
    wp::array_t<float>& v_hyper, wp::array_t<float>& v_motion, wp::array_t<float>& v_reach
) {
    FUSE_WITHIN_EXPRESSIONS
    const int N = means.shape[0], H = has_hyper ? hyper.shape[1] : 0;
    const vi upper = lane_numbers() >= 12.0f;
    const int M = motion.shape[0];
    float* motion_sum = v_motion.data + (long long)chunk * M * 16;
    float* reach_sum = v_reach.data + (long long)chunk * M * 16;
    __builtin_memset(motion_sum, 0, 64ll * M);
    __builtin_memset(reach_sum, 0, 64ll * M);
    auto run = [&](auto kc, int begin) __attribute__((always_inline)) {
        const int K = decltype(kc)::value ? decltype(kc)::value : indices.shape[1];
        const int rows = N - begin < 16 ? N - begin : 16;
        vf x[3], q[4];
        int spare_picks[16 * MAX_NEIGHBORS];
        float spare_weights[16 * MAX_NEIGHBORS];
        read_vectors(means.data, begin, rows, 3, x);
        read_vectors(quats.data, begin, rows, 4, q);
        const int* pick = (const int*)read_rows(indices.data + (long long)begin * K, rows, 4 * K, spare_picks);
        vf hyper_point[MAX_HYPER];
        read_hyper(hyper, H, begin, rows, hyper_point);
        const float* weight = (const float*)read_rows(weights.data + (long long)begin * K, rows, 4 * K, spare_weights);
        vf w[MAX_NEIGHBORS], v[3], t[4], v_extras_of[3];
        weight_columns(weight, K, w);
        read_vectors(v_means_t.data, begin, rows, 3, v);
        read_vectors(v_quats_t.data, begin, rows, 4, t);
        if (has_extras) read_vectors(v_extras_t.data, begin, rows, 3, v_extras_of);
        vf B[16], side[MAX_NEIGHBORS], b[4], u[4], v_x[3], rows_of[16];
        blend(motion.data, pick, weight, w, K, aligned, side, B);
        // Non-finite Gaussians, Gaussians moved by a non-finite control point, and lanes past the end pass no gradient:
        // they become zeros with zero weights.
        vf probe = q[0] * 0.0f + q[1] * 0.0f + q[2] * 0.0f + q[3] * 0.0f;
        for (int d = 0; d < H; ++d) probe = probe + hyper_point[d] * 0.0f;
        vi alive = (probe == 0.0f) & (lane_numbers() < (float)rows);
        for (int c = 0; c < 3; ++c) alive = alive & near(x[c]);
        for (int c = 0; c < 16; ++c) alive = alive & near(B[c]);
        if (!__builtin_reduce_and(alive)) {
            for (int c = 0; c < 16; ++c) B[c] = alive ? B[c] : vf{};
            for (int k = 0; k < K; ++k) w[k] = alive ? w[k] : vf{};
            for (int c = 0; c < 3; ++c) {
                x[c] = alive ? x[c] : vf{};
                v[c] = alive ? v[c] : vf{};
            }
            for (int c = 0; c < 4; ++c) {
                q[c] = alive ? q[c] : vf{};
                t[c] = alive ? t[c] : vf{};
            }
            for (int c = 0; c < 3 && has_extras; ++c) v_extras_of[c] = alive ? v_extras_of[c] : vf{};
            for (int d = 0; d < H; ++d) hyper_point[d] = alive ? hyper_point[d] : vf{};
            weight_rows(w, K, spare_weights);
            weight = spare_weights;
        }
        vf nb = inverse_norm(B[12], B[13], B[14], B[15]), nq = inverse_norm(q[0], q[1], q[2], q[3]);
        normalise(B + 12, nb, b);
        normalise(q, nq, u);
        vf v_u[4] = {
            // conj(b) t
            b[0] * t[0] + b[1] * t[1] + b[2] * t[2] + b[3] * t[3],
            b[0] * t[1] - b[1] * t[0] - b[2] * t[3] + b[3] * t[2],
            b[0] * t[2] + b[1] * t[3] - b[2] * t[0] - b[3] * t[1], b[0] * t[3] - b[1] * t[2] + b[2] * t[1] - b[3] * t[0]
        };
        vf v_b[4] = {
            // t conj(u)
            t[0] * u[0] + t[1] * u[1] + t[2] * u[2] + t[3] * u[3],
            t[1] * u[0] - t[0] * u[1] - t[2] * u[3] + t[3] * u[2],
            t[2] * u[0] - t[0] * u[2] + t[1] * u[3] - t[3] * u[1], t[3] * u[0] - t[0] * u[3] - t[1] * u[2] + t[2] * u[1]
        };
        vf along_u = v_u[0] * u[0] + v_u[1] * u[1] + v_u[2] * u[2] + v_u[3] * u[3];
        vf along_b = v_b[0] * b[0] + v_b[1] * b[1] + v_b[2] * b[2] + v_b[3] * b[3];
        for (int c = 0; c < 3; ++c) {
            v_x[c] = B[c] * v[0] + B[4 + c] * v[1] + B[8 + c] * v[2];
            for (int d = 0; d < 3; ++d) rows_of[4 * c + d] = v[c] * x[d];
            rows_of[4 * c + 3] = v[c];
        }
        for (int c = 0; c < 4; ++c) {
            v_u[c] = (v_u[c] - u[c] * along_u) * nq;
            rows_of[12 + c] = (v_b[c] - b[c] * along_b) * nb;
        }
        // A gradient that overflows becomes 0; an incoming NaN stays NaN.
        const vi given =
            usable(v[0]) & usable(v[1]) & usable(v[2]) & usable(t[0]) & usable(t[1]) & usable(t[2]) & usable(t[3]);
        for (int c = 0; c < 4; ++c) v_u[c] = (usable(v_u[c]) | ~given) ? v_u[c] : vf{};
        write_vectors(v_quats.data, begin, rows, 4, v_u);
        transpose(rows_of);  // row l: gradient of Gaussian l's blended motion row
        vf v_weight[MAX_NEIGHBORS], mean = vf{};
        for (int k = 0; k < K; ++k) {
            vf products[16];
            float turned[16];
            if (!aligned) store(turned, side[k], 16);
            for (int l = 0; l < 16; ++l) {
                vf g = aligned ? rows_of[l] : (upper ? vf{} + turned[l] : vf{} + 1.0f) * rows_of[l];
                products[l] = g * load16(motion.data + 16ll * pick[l * K + k]);
                float* sum = motion_sum + 16ll * pick[l * K + k];
                store(sum, load16(sum) + weight[l * K + k] * g, 16);
            }
            v_weight[k] = lane_sums(products);
            if (has_extras) {
                vf node[4];
                gather4(reach.data + 4, pick, K, k, node);
                for (int c = 0; c < 3; ++c) v_weight[k] = v_weight[k] + v_extras_of[c] * node[1 + c];
            }
            v_weight[k] = (alive & usable(v_weight[k])) ? v_weight[k] : vf{};
            mean = mean + w[k] * v_weight[k];
        }
        vf v_hyper_point[MAX_HYPER] = {};
        for (int k = 0; k < K; ++k) {
            vf e[4 + MAX_HYPER], part[4];
            vf d2 = offset(reach.data, pick, K, k, x, hyper_point, H, e);
            const vf v_logit = w[k] * (v_weight[k] - mean);
            const vi moves = v_logit != 0.0f;  // in other lanes the distance may be non-finite
            vf factor = moves ? 2.0f * e[3] * v_logit : vf{};
            for (int c = 0; c < 3; ++c) {
                e[c] = moves ? e[c] : vf{};
                v_x[c] = v_x[c] + factor * e[c];
                part[c] = v_logit * e[c];
            }
            part[3] = moves ? v_logit * d2 : vf{};
            add4(reach_sum, pick, K, k, part);
            if (has_strengths || has_extras) {
                part[0] = v_logit;
                for (int c = 0; c < 3; ++c) part[1 + c] = has_extras ? w[k] * v_extras_of[c] : vf{};
                add4(reach_sum + 4, pick, K, k, part);
            }
            for (int h = 0; h < H; h += 4) {
                for (int c = 0; c < 4; ++c) {
                    vf other = moves ? e[4 + h + c] : vf{};
                    v_hyper_point[h + c] = v_hyper_point[h + c] + factor * other;
                    part[c] = v_logit * other;
                }
                add4(reach_sum + 8 + h, pick, K, k, part);
            }
        }
        for (int c = 0; c < 3; ++c) v_x[c] = (usable(v_x[c]) | ~given) ? v_x[c] : vf{};
        write_vectors(v_means.data, begin, rows, 3, v_x);
        for (int d = 0; d < H; ++d) {
            float lanes[16];
            store(lanes, usable(v_hyper_point[d]) ? v_hyper_point[d] : vf{}, 16);
            for (int l = 0; l < rows; ++l) v_hyper.data[(begin + l) * (long long)H + d] = lanes[l];
        }
    };
    const int end = (chunk + 1) * size < N ? (chunk + 1) * size : N;
    for (int begin = chunk * size; begin < end; begin += 16) {
        by_count()(indices.shape[1], [&](auto kc) __attribute__((always_inline)) { run(kc, begin); });
    }
}
