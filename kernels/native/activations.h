// Exponential and sigmoid functions of 16 values.
#pragma once
#include "exponential.h"

// Return e^x over the whole range of floats: the power of two is multiplied in two halves.
ALWAYS_INLINE vf whole_exponential(vf x) {
    FUSE_WITHIN_EXPRESSIONS
    const vf low = x < -104.0f ? vf{} - 104.0f : x;
    const vf y = low > 89.0f ? vf{} + 89.0f : low;
    const vf shifted = y * 1.44269504f + 12582912.0f;
    const vf n = shifted - 12582912.0f;
    const vi whole = __builtin_convertvector(n, vi), half = whole >> 1;
    const vf first = (vf)((half + 127) << 23), second = (vf)((whole - half + 127) << 23);
    return exponential_series(y, n) * first * second;
}

static inline void exponential_block(int begin, const wp::array_t<float>& values, wp::array_t<float>& results) {
    const int n = values.shape[0] - begin < 16 ? values.shape[0] - begin : 16;
    store(results.data + begin, whole_exponential(load(values.data + begin, n)), n);
}

ALWAYS_INLINE vf sigmoid_of(vf x) { return 1.0f / (1.0f + whole_exponential(-x)); }

static inline void sigmoid_block(int begin, const wp::array_t<float>& values, wp::array_t<float>& results) {
    const int n = values.shape[0] - begin < 16 ? values.shape[0] - begin : 16;
    store(results.data + begin, sigmoid_of(load(values.data + begin, n)), n);
}
