// Rows of an array as columns, one row per lane, and back.
#pragma once
#include "shuffles.h"

ALWAYS_INLINE vf load16(const float* from) { return load(from, 16); }

// Return the rows themselves if there are 16 of them; else copy them to `spare`, with zeros behind them.
ALWAYS_INLINE const void* read_rows(const void* from, int rows, int row_bytes, void* spare) {
    if (rows == 16) return from;
    __builtin_memset(spare, 0, 16 * row_bytes);
    __builtin_memcpy(spare, from, row_bytes * rows);
    return spare;
}

// Prefetch the rows of the next block: a thread's blocks follow one another, in more streams than the processor follows
// by itself.
ALWAYS_INLINE void prefetch_next(const void* data, int begin, int width) {
    const float* next = (const float*)data + (begin + 16ll) * width;
    for (int line = 0; line < width; ++line) __builtin_prefetch(next + 16 * line);
}

// Load rows begin to begin + rows - 1 of an array of vectors of `width` floats (2, 3 or 4) as columns.
ALWAYS_INLINE void read_vectors(const void* data, int begin, int rows, int width, vf* to) {
    float spare[64];
    prefetch_next(data, begin, width);
    const float* first = (const float*)data + (long long)begin * width;
    const float* from = (const float*)read_rows(first, rows, 4 * width, spare);
    vf a[4];
    for (int i = 0; i < width; ++i) a[i] = load16(from + 16 * i);
    if (width == 4)
        split4(a, to);
    else if (width == 3)
        split3(a, to);
    else
        split2(a, to);
}

// Write columns as rows begin to begin + rows - 1 of an array of vectors of `width` floats.
ALWAYS_INLINE void write_vectors(void* data, int begin, int rows, int width, const vf* from) {
    vf a[4];
    prefetch_next(data, begin, width);
    if (width == 4)
        join4(from, a);
    else if (width == 3)
        join3(from, a);
    else
        join2(from, a);
    __builtin_memcpy((float*)data + (long long)begin * width, a, rows == 16 ? 64 * width : 4 * width * rows);
}

// Read 16 columns, from column `from` on, of the rows of an array of `size` floats. Lanes past the last row are zeros;
// columns past the width hold whatever follows.
ALWAYS_INLINE void read_columns(const float* data, long long size, int begin, int rows, int width, int from, vf* to) {
    for (int l = 0; l < 16; ++l) {
        const long long at = (long long)(begin + l) * width + from;
        if (at + 16 <= size && l < rows)
            to[l] = load16(data + at);
        else {
            float spare[16] = {};
            for (int k = 0; at + k < size && l < rows; ++k) spare[k] = data[at + k];
            to[l] = load16(spare);
        }
    }
    transpose(to);
}

// Write `count` columns, from column `from` on. Changes `columns`, which are 16.
ALWAYS_INLINE void write_columns(float* data, int begin, int rows, int width, int from, int count, vf* columns) {
    transpose(columns);
    for (int l = 0; l < rows; ++l)
        __builtin_memcpy(data + (long long)(begin + l) * width + from, &columns[l], 4 * count);
}
