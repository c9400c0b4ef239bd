// Code shared by skinning and its adjoint, for blocks of 16 Gaussians in lanes, with control points as rows of memory.
//
// Control points (nodes) are the rows of cpu/skinning_palette.py: two tables, `motion` and `reach`, with 16 floats per
// node. `pick` holds node indices, [16, K]. Lanes past the last Gaussian are zero and refer to node 0.
#pragma once
#include "columns.h"

typedef float v4 __attribute__((vector_size(16), aligned(4)));

// Return a function that calls run(K): with a type that holds the usual four neighbours, so that loops over them are
// unrolled, or with one that holds 0 and leaves the number open.
static inline auto by_count() {
    struct Any {
        enum { value = 0 };
    };
    struct Four {
        enum { value = 4 };
    };
    return [](int neighbors, auto run) __attribute__((always_inline)) {
        if (neighbors == 4)
            run(Four{});
        else
            run(Any{});
    };
}

// Load one column for each hyper-coordinate, with zeros behind the last.
ALWAYS_INLINE void read_hyper(const wp::array_t<float>& hyper, int H, int begin, int rows, vf* to) {
    if (!H) return;
    for (int d = 0; d < MAX_HYPER; ++d) {
        float lanes[16] = {};
        for (int l = 0; l < rows && d < H; ++l) lanes[l] = hyper.data[(begin + l) * (long long)H + d];
        to[d] = load16(lanes);
    }
}

// Load four floats of the rows of neighbour k as columns; `table` points at the first of the four in node 0's row.
ALWAYS_INLINE void gather4(const float* table, const int* pick, int K, int k, vf* to) {
    vf a[4];  // quarter l of a[i]: lane 4 l + i
    for (int i = 0; i < 4; ++i) {
        v4 r[4];
        for (int l = 0; l < 4; ++l) r[l] = *(const v4*)(table + 16ll * pick[(4 * l + i) * K + k]);
        auto low = __builtin_shufflevector(r[0], r[1], 0, 1, 2, 3, 4, 5, 6, 7);
        auto high = __builtin_shufflevector(r[2], r[3], 0, 1, 2, 3, 4, 5, 6, 7);
        a[i] = __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    }
    quads(a, to);
}

// Store columns of weights as rows of memory, [16, K].
ALWAYS_INLINE void weight_rows(const vf* columns, int K, float* to) {
    if (K == 4) {
        vf a[4];
        join4(columns, a);
        __builtin_memcpy(to, a, 256);
    } else
        for (int k = 0; k < K; ++k) {
            float lanes[16];
            store(lanes, columns[k], 16);
#pragma clang loop vectorize(disable)
            for (int l = 0; l < 16; ++l) to[l * K + k] = lanes[l];
        }
}

ALWAYS_INLINE void weight_columns(const float* from, int K, vf* to) {
    if (K == 4) {
        vf a[4];
        for (int i = 0; i < 4; ++i) a[i] = load16(from + 16 * i);
        split4(a, to);
    } else
        for (int k = 0; k < K; ++k) {
            float lanes[16];
#pragma clang loop vectorize(disable)
            for (int l = 0; l < 16; ++l) lanes[l] = from[l * K + k];
            to[k] = load16(lanes);
        }
}

// Blend the motion rows: affine map (12 columns), rotation (4). A quaternion on the other side of the first neighbour's
// is negated: its `side` is -1. If `aligned`, all are on one side. `weight` and `weights_of` are the same weights, as
// rows and as columns.
ALWAYS_INLINE void blend(
    const float* motion, const int* pick, const float* weight, const vf* weights_of, int K, int aligned, vf* side,
    vf* columns
) {
    FUSE_WITHIN_EXPRESSIONS
    for (int l = 0; l < 16; ++l) {
        vf row = vf{} + weight[l * K] * load16(motion + 16ll * pick[l * K]);
        for (int k = 1; k < K; ++k) row = row + weight[l * K + k] * load16(motion + 16ll * pick[l * K + k]);
        columns[l] = row;
    }
    transpose(columns);
    if (!aligned) {
        vf front[4], r[4];
        gather4(motion + 12, pick, K, 0, front);
        side[0] = vf{} + 1.0f;
        for (int c = 0; c < 4; ++c) columns[12 + c] = weights_of[0] * front[c];
        for (int k = 1; k < K; ++k) {
            gather4(motion + 12, pick, K, k, r);
            vf cosine = r[0] * front[0] + r[1] * front[1] + r[2] * front[2] + r[3] * front[3];
            side[k] = cosine < 0.0f ? vf{} - 1.0f : vf{} + 1.0f;
            vf w = weights_of[k] * side[k];
            for (int c = 0; c < 4; ++c) columns[12 + c] = columns[12 + c] + w * r[c];
        }
    }
}

// Write e = x - p of neighbour k, then -1 / (2 r^2), then hyper-coordinates from e[4] on. Return the squared distance.
ALWAYS_INLINE vf
offset(const float* reach, const int* pick, int K, int k, const vf* x, const vf* hyper_point, int H, vf* e) {
    FUSE_WITHIN_EXPRESSIONS
    vf node[4];
    gather4(reach, pick, K, k, node);
    for (int c = 0; c < 3; ++c) e[c] = x[c] - node[c];
    e[3] = node[3];
    vf d2 = e[0] * e[0] + e[1] * e[1] + e[2] * e[2];
    for (int h = 0; h < H; h += 4) {
        gather4(reach + 8 + h, pick, K, k, node);
        for (int c = 0; c < 4; ++c) {
            vf& other = e[4 + h + c];
            other = hyper_point[h + c] - node[c];
            d2 = d2 + other * other;
        }
    }
    return d2;
}

// Return the inverse norm of a quaternion; 0 where the norm is 0 or non-finite.
ALWAYS_INLINE vf inverse_norm(vf a, vf b, vf c, vf d) {
    FUSE_WITHIN_EXPRESSIONS
    vf n = a * a + b * b + c * c + d * d;
    return ((n > 0.0f) & (n < __builtin_inff())) ? 1.0f / __builtin_elementwise_sqrt(n) : vf{};
}

// Return the unit quaternion, given the inverse norm; the identity where that is 0.
ALWAYS_INLINE void normalise(const vf* q, vf inverse, vf* unit) {
    for (int c = 0; c < 4; ++c) {
        vf identity = vf{} + (c == 0 ? 1.0f : 0.0f);
        unit[c] = inverse > 0.0f ? q[c] * inverse : identity;
    }
}
