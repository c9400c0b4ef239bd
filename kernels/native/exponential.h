// The exponential function and the logarithm of 16 floats.
#pragma once
#include "simd.h"

// Return e^(x - n ln 2) for the integer n nearest to x / ln 2, by its series.
ALWAYS_INLINE vf exponential_series(vf x, vf n) {
    FUSE_WITHIN_EXPRESSIONS
    const vf f = x - n * 0.693359375f + n * 2.12194440e-4f;
    return 1.0f +
           f * (1.0f + f * (0.5f + f * (0.16666667f + f * (4.16666667e-2f + f * (8.3333333e-3f + f * 1.3888889e-3f)))));
}

// Return e^x for x <= 88; 0 below -87.
ALWAYS_INLINE vf exponential(vf x) {
    FUSE_WITHIN_EXPRESSIONS
    const vf y = x < -87.0f ? vf{} - 87.0f : x;
    const vf shifted = y * 1.44269504f + 12582912.0f;
    const vf n = shifted - 12582912.0f;
    const vi exponent = (__builtin_convertvector(n, vi) + 127) << 23;
    return x < -87.0f ? vf{} : exponential_series(y, n) * (vf)exponent;
}

// Return log2 of positive normal numbers, to 2e-7 of the result or of 1, whichever is larger. With the mantissa m in
// [0.707, 1.414), log m is a series in (m - 1) / (m + 1).
ALWAYS_INLINE vf logarithm2(vf x) {
    FUSE_WITHIN_EXPRESSIONS
    const vi shifted = (vi)x - 0x3f3504f3;
    const vf exponent = __builtin_convertvector(shifted >> 23, vf);
    const vf m = (vf)((shifted & 0x7fffff) + 0x3f3504f3);
    const vf s = (m - 1.0f) / (m + 1.0f), z = s * s;
    const vf series = 2.88539008f + z * (0.961796694f + z * (0.577078016f + z * (0.412198583f + z * 0.320598898f)));
    return exponent + s * series;
}
