// Lists of the nodes within reach of a block of points.
#pragma once
#include "simd.h"

// Write the nodes within `reach` of the block's centre, ascending, and their number (-1 if there are too many).
static inline void list_within(
    int block, float reach, const wp::array_t<float>& centres, const wp::array_t<float>& columns,
    wp::array_t<int>& counts, wp::array_t<int>& lists
) {
    FUSE_WITHIN_EXPRESSIONS
    const int D = columns.shape[0], M = columns.shape[1], room = lists.shape[1];
    const float* centre = centres.data + (long long)block * (D + 1);
    int* list = lists.data + (long long)block * room;
    int count = 0;
    for (int m = 0; m < M && count <= room; m += 16) {
        const int lanes = M - m < 16 ? M - m : 16;
        vf d2 = {};
        for (int d = 0; d < D; ++d) {
            vf e = {};
            __builtin_memcpy(&e, columns.data + (long long)d * M + m, 4 * lanes);
            e = e - centre[d];
            d2 = d2 + e * e;
        }
        unsigned near = bits(d2 < reach * reach);
        for (near &= (1u << lanes) - 1; near; near &= near - 1, ++count)
            if (count < room) list[count] = m + __builtin_ctz(near);
    }
    counts.data[block] = count <= room ? count : -1;
}
