// Sums over the lanes of 16 vectors at a time.
#pragma once
#include "simd.h"

// Four steps each fold the halves of vectors together, pair by pair.
static inline vf fold8(vf a, vf b) {
    return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
           __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
}
static inline vf fold4(vf a, vf b) {
    return __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27) +
           __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
}
static inline vf fold2(vf a, vf b) {
    return __builtin_shufflevector(a, b, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29) +
           __builtin_shufflevector(a, b, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
}
static inline vf fold1(vf a, vf b) {
    return __builtin_shufflevector(a, b, 0, 2, 16, 18, 4, 6, 20, 22, 8, 10, 24, 26, 12, 14, 28, 30) +
           __builtin_shufflevector(a, b, 1, 3, 17, 19, 5, 7, 21, 23, 9, 11, 25, 27, 13, 15, 29, 31);
}

// Lane k of the result is the sum of v[k]'s lanes.
static inline vf lane_sums(const vf* v) {
    vf part[4];  // part[k] holds sums k, 4 + k, 8 + k, 12 + k, so that the result is in order
    for (int k = 0; k < 4; ++k) part[k] = fold4(fold8(v[k], v[4 + k]), fold8(v[8 + k], v[12 + k]));
    return fold1(fold2(part[0], part[1]), fold2(part[2], part[3]));
}
