// Depth of 16 pixels.
#pragma once
#include "simd.h"

// Divide the accumulated depth by alpha, then by the unit in double precision.
static inline void expected_depth_block(
    int begin, const wp::array_t<float>& accumulated, const wp::array_t<float>& alpha, double unit,
    wp::array_t<float>& depth
) {
    FUSE_WITHIN_EXPRESSIONS
    const int n = depth.shape[0] - begin < 16 ? depth.shape[0] - begin : 16;
    vf cover = load(alpha.data + begin, n);
    cover = cover > 1e-10f ? cover : vf{} + 1e-10f;
    const vf mean = load(accumulated.data + begin, n) / cover;
    store(depth.data + begin, __builtin_convertvector(__builtin_convertvector(mean, vd) * (1.0 / unit), vf), n);
}
