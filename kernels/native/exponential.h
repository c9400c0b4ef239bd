// The exponential function of 16 floats.
#pragma once
#include "simd.h"

// Return e^x for x <= 88; 0 below -87.
ALWAYS_INLINE vf exponential(vf x) {
    FUSE_WITHIN_EXPRESSIONS
    vf y = x < -87.0f ? vf{} - 87.0f : x;
    vf shifted = y * 1.44269504f + 12582912.0f;
    vf n = shifted - 12582912.0f;
    vf f = y - n * 0.693359375f + n * 2.12194440e-4f;
    vf p = 1.0f +
           f * (1.0f + f * (0.5f + f * (0.16666667f + f * (4.16666667e-2f + f * (8.3333333e-3f + f * 1.3888889e-3f)))));
    vi exponent = (__builtin_convertvector(n, vi) + 127) << 23;
    return x < -87.0f ? vf{} : p * (vf)exponent;
}
