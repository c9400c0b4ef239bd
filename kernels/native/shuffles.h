// Shuffles of whole registers between rows of memory and lanes.
#pragma once
#include "simd.h"

#define EVEN_QUARTERS 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27
#define ODD_QUARTERS 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31

// Turn 16 rows of two floats, in two registers, into two columns.
ALWAYS_INLINE void split2(const vf* a, vf* to) {
    to[0] = __builtin_shufflevector(a[0], a[1], 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    to[1] = __builtin_shufflevector(a[0], a[1], 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
}

// Turn two columns into 16 rows of two floats, in two registers.
ALWAYS_INLINE void join2(const vf* a, vf* to) {
    to[0] = __builtin_shufflevector(a[0], a[1], 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
    to[1] = __builtin_shufflevector(a[0], a[1], 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
}

// Turn 16 rows of three floats, in three registers, into three columns.
ALWAYS_INLINE void split3(const vf* a, vf* to) {
    to[0] = __builtin_shufflevector(
        __builtin_shufflevector(a[0], a[1], 0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0), a[2], 0, 1, 2, 3, 4,
        5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29
    );
    to[1] = __builtin_shufflevector(
        __builtin_shufflevector(a[0], a[1], 1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0), a[2], 0, 1, 2, 3,
        4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30
    );
    to[2] = __builtin_shufflevector(
        __builtin_shufflevector(a[0], a[1], 2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0), a[2], 0, 1, 2, 3, 4,
        5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31
    );
}

// Turn three columns into 16 rows of three floats, in three registers.
ALWAYS_INLINE void join3(const vf* a, vf* to) {
    to[0] = __builtin_shufflevector(
        __builtin_shufflevector(a[0], a[1], 0, 16, 0, 1, 17, 0, 2, 18, 0, 3, 19, 0, 4, 20, 0, 5), a[2], 0, 1, 16, 3, 4,
        17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15
    );
    to[1] = __builtin_shufflevector(
        __builtin_shufflevector(a[0], a[1], 21, 0, 6, 22, 0, 7, 23, 0, 8, 24, 0, 9, 25, 0, 10, 26), a[2], 0, 21, 2, 3,
        22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15
    );
    to[2] = __builtin_shufflevector(
        __builtin_shufflevector(a[0], a[1], 0, 11, 27, 0, 12, 28, 0, 13, 29, 0, 14, 30, 0, 15, 31, 0), a[2], 26, 1, 2,
        27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31
    );
}

// Turn 16 rows of four floats, in four registers, into four columns.
ALWAYS_INLINE void split4(const vf* a, vf* to) {
    vf u00 = __builtin_shufflevector(a[0], a[1], 0, 4, 8, 12, 16, 20, 24, 28, 1, 5, 9, 13, 17, 21, 25, 29);
    vf u01 = __builtin_shufflevector(a[2], a[3], 0, 4, 8, 12, 16, 20, 24, 28, 1, 5, 9, 13, 17, 21, 25, 29);
    vf u10 = __builtin_shufflevector(a[0], a[1], 2, 6, 10, 14, 18, 22, 26, 30, 3, 7, 11, 15, 19, 23, 27, 31);
    vf u11 = __builtin_shufflevector(a[2], a[3], 2, 6, 10, 14, 18, 22, 26, 30, 3, 7, 11, 15, 19, 23, 27, 31);
    to[0] = __builtin_shufflevector(u00, u01, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
    to[1] = __builtin_shufflevector(u00, u01, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
    to[2] = __builtin_shufflevector(u10, u11, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
    to[3] = __builtin_shufflevector(u10, u11, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
}

// Turn four columns into 16 rows of four floats, in four registers.
ALWAYS_INLINE void join4(const vf* a, vf* to) {
    vf u00 = __builtin_shufflevector(a[0], a[1], 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
    vf u01 = __builtin_shufflevector(a[0], a[1], 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
    vf u10 = __builtin_shufflevector(a[2], a[3], 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
    vf u11 = __builtin_shufflevector(a[2], a[3], 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
    to[0] = __builtin_shufflevector(u00, u10, 0, 1, 16, 17, 2, 3, 18, 19, 4, 5, 20, 21, 6, 7, 22, 23);
    to[1] = __builtin_shufflevector(u00, u10, 8, 9, 24, 25, 10, 11, 26, 27, 12, 13, 28, 29, 14, 15, 30, 31);
    to[2] = __builtin_shufflevector(u01, u11, 0, 1, 16, 17, 2, 3, 18, 19, 4, 5, 20, 21, 6, 7, 22, 23);
    to[3] = __builtin_shufflevector(u01, u11, 8, 9, 24, 25, 10, 11, 26, 27, 12, 13, 28, 29, 14, 15, 30, 31);
}

// Transpose the 4 x 4 matrices that the quarters of four registers form: shuffles within quarters are the cheapest.
ALWAYS_INLINE void quads(const vf* a, vf* to) {
    vf low0 = __builtin_shufflevector(a[0], a[1], 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29);
    vf high0 = __builtin_shufflevector(a[0], a[1], 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31);
    vf low1 = __builtin_shufflevector(a[2], a[3], 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29);
    vf high1 = __builtin_shufflevector(a[2], a[3], 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31);
    to[0] = __builtin_shufflevector(low0, low1, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29);
    to[1] = __builtin_shufflevector(low0, low1, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    to[2] = __builtin_shufflevector(high0, high1, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29);
    to[3] = __builtin_shufflevector(high0, high1, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
}

// Transpose 16 x 16: four rows at a time within quarters, then whole quarters.
ALWAYS_INLINE void transpose(vf* rows) {
    vf q[4][4];
    for (int g = 0; g < 4; ++g) quads(rows + 4 * g, q[g]);
    for (int j = 0; j < 4; ++j) {
        const vf even0 = __builtin_shufflevector(q[0][j], q[1][j], EVEN_QUARTERS);
        const vf odd0 = __builtin_shufflevector(q[0][j], q[1][j], ODD_QUARTERS);
        const vf even2 = __builtin_shufflevector(q[2][j], q[3][j], EVEN_QUARTERS);
        const vf odd2 = __builtin_shufflevector(q[2][j], q[3][j], ODD_QUARTERS);
        rows[j] = __builtin_shufflevector(even0, even2, EVEN_QUARTERS);
        rows[4 + j] = __builtin_shufflevector(odd0, odd2, EVEN_QUARTERS);
        rows[8 + j] = __builtin_shufflevector(even0, even2, ODD_QUARTERS);
        rows[12 + j] = __builtin_shufflevector(odd0, odd2, ODD_QUARTERS);
    }
}
