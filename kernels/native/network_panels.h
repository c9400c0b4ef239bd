// Matrices in panels of 32 columns, and the loop that multiplies them.
//
// Element (i, j) of a matrix with R rows is at ((j / 32) R + i) 32 + j % 32. All products (values, adjoint of values,
// adjoint of weights) then stream through memory in one direction, and all use the same loop: a tile of rows x columns
// of the result stays in registers, and each step adds the product of one column of the left factor with one row of the
// right factor. One thread computes each sum in the order of its index, so results depend neither on the number of
// threads nor on how the rows are cut into blocks.
#pragma once
#include "simd.h"

// Columns of the table of layers:
enum {
    WEIGHTS,          // address of the weights [out, in]
    BIAS,             // address of the bias [out]
    INPUTS,           // columns read from the inputs
    HIDDEN,           // columns read from the layer before
    OUTPUTS,          // columns written
    PACKED,           // offset of the layer's packed weights: for values,
    PACKED_ADJOINT,   // for the adjoint of the layer before (-1: not wanted),
    PACKED_INPUTS,    // for the adjoint of the inputs (-1: not wanted)
    WEIGHTS_ADJOINT,  // address of the gradient of the weights, which that of the bias follows
    TABLE_COLUMNS,
};

enum { PANEL = NETWORK_PANEL };  // columns of a panel

// Size of the tile of a result kept in registers, for the processor that the compiler was given. Of AVX-512's and
// NEON's 32 registers 16 are accumulators, of AVX's 16 only 8, which just hide the latency of two multiply-adds a
// cycle. There is no case for x86 without AVX, because Warp's own code needs F16C.
#if defined(__AVX512F__)
enum { LANES = 16, ROWS = 8, VECTORS = 2 };
#elif defined(__AVX__)
enum { LANES = 8, ROWS = 4, VECTORS = 2 };
#else
enum { LANES = 4, ROWS = 8, VECTORS = 2 };
#endif
enum { STRIP = LANES * VECTORS };  // columns of a tile

// Attribute of functions that compute on such registers. Without it Clang cuts registers of 512 bits into halves where
// it tunes for an Intel CPU, unless the function takes or returns one.
#if defined(__AVX512F__)
#define WHOLE_REGISTERS __attribute__((min_vector_width(512)))
#else
#define WHOLE_REGISTERS
#endif

// One register of the CPU, and the same type without alignment.
typedef float vn __attribute__((vector_size(LANES * 4)));
typedef float vnu __attribute__((vector_size(LANES * 4), aligned(4)));

// Distances between elements of a left factor, as types.
struct One {
    enum { value = 1 };
};
struct Panel {
    enum { value = PANEL };
};

static inline int panels(long long columns) { return (int)((columns + PANEL - 1) / PANEL); }

// Return a function: sums[r][v] += sum over k < n of left(r, k) right(k, v), where left(r, k) is at
// left[r * row + k * step]. It works on a copy of the sums, which stays in registers.
static inline auto accumulation() {
    FUSE_WITHIN_EXPRESSIONS
    return [](auto& sums, const float* left, auto row, auto step, const float* right, int n) {
        constexpr int V = sizeof(sums[0]) / sizeof(vn);
        vn acc[ROWS][V];
#pragma clang loop unroll(full)
        for (int r = 0; r < ROWS; ++r)
#pragma clang loop unroll(full)
            for (int v = 0; v < V; ++v) acc[r][v] = sums[r][v];
        for (const float* end = right + n * PANEL; right < end; right += PANEL, left += step.value) {
            vn b[V];
#pragma clang loop unroll(full)
            for (int v = 0; v < V; ++v) b[v] = *(const vnu*)(right + v * LANES);
#pragma clang loop unroll(full)
            for (int r = 0; r < ROWS; ++r) {
                const float a = left[r * row.value];
#pragma clang loop unroll(full)
                for (int v = 0; v < V; ++v) acc[r][v] += a * b[v];
            }
        }
#pragma clang loop unroll(full)
        for (int r = 0; r < ROWS; ++r)
#pragma clang loop unroll(full)
            for (int v = 0; v < V; ++v) sums[r][v] = acc[r][v];
    };
}

// Return functions that read a tile of sums from, and write it to, the rows of a matrix with ``stride`` columns: the
// part of the tile that exists, in vectors where they fit.
static inline auto visit_tile() {
    return [](auto& sums, float* at, long long stride, int rows, int columns, auto vector, auto number) {
        for (int r = 0; r < ROWS && r < rows; ++r)
            for (int v = 0; v < VECTORS; ++v) {
                float* to = at + r * stride + v * LANES;
                if ((v + 1) * LANES <= columns)
                    vector(to, sums[r][v]);
                else
                    for (int s = 0; s < LANES && v * LANES + s < columns; ++s) number(to + s, sums[r][v], s);
            }
    };
}
static inline auto read_tile() {
    return [](auto& sums, const float* from, long long stride, int rows, int columns) {
        visit_tile()(
            sums, (float*)from, stride, rows, columns, [](float* at, vn& sum) { sum = *(const vnu*)at; },
            [](float* at, vn& sum, int s) { sum[s] = *at; }
        );
    };
}
static inline auto write_tile() {
    return [](auto& sums, float* to, long long stride, int rows, int columns) {
        visit_tile()(
            sums, to, stride, rows, columns, [](float* at, vn sum) { *(vnu*)at = sum; },
            [](float* at, vn sum, int s) { *at = sum[s]; }
        );
    };
}
