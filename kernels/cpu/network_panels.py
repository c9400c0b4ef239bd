"""Matrices in panels of 32 columns, and the loop that multiplies them: what the network's CPU kernels share.

Element (i, j) of a matrix with R rows is at ``((j / 32) R + i) 32 + j % 32``. All products (values, adjoint of values,
adjoint of weights) then stream through memory in one direction, and all are the same loop: a tile of rows x columns of
the result stays in registers while one column of the left factor at a time meets one row of the right factor. Each sum
is taken in the order of its index, by one thread: the bits depend neither on the number of threads nor on how the rows
are cut into blocks.
"""

from __future__ import annotations

PANEL = 32
"""Columns of a panel. Widths of hidden layers are multiples of it."""

BLOCK = 32
"""Rows that one grid index takes through all layers; matrices have a multiple of 8 rows."""

TABLE_COLUMNS = 9
"""Columns of the table of layers, as the enumeration in ``PRELUDE``: address of the weights [out, in] and of the bias
[out], columns read from the inputs and from the layer before, columns written, where the layer's packed weights begin
(for values, for the adjoint of the layer before, for that of the inputs; -1 where nobody wants it), address of the
gradient of the weights (that of the bias lies behind it)."""

PRELUDE = """
    #pragma clang fp contract(on)
    enum { WEIGHTS, BIAS, INPUTS, HIDDEN, OUTPUTS, PACKED, PACKED_ADJOINT, PACKED_INPUTS, GRADIENT, COLUMNS };
    enum { PANEL = 32 };
    // The tile of a result that fits into the registers: 16 accumulators hide the latency of a fused multiply-add.
    #if defined(__AVX512F__)
    enum { LANES = 16, ROWS = 8, VECTORS = 2 };
    #elif defined(__AVX__)
    enum { LANES = 8, ROWS = 4, VECTORS = 2 };
    #else
    enum { LANES = 4, ROWS = 8, VECTORS = 2 };
    #endif
    typedef float vn __attribute__((vector_size(LANES * 4)));
    typedef float vnu __attribute__((vector_size(LANES * 4), aligned(4)));
    typedef int vm __attribute__((vector_size(LANES * 4)));
    enum { STRIP = LANES * VECTORS };  // columns of a tile

    // sums[r][v] += sum over k < n of left(r, k) right(k, v), where left(r, k) is at left[r * row + k * step]. The copy
    // is what stays in registers, whatever the caller does with its own.
    auto accumulate = [](auto& sums, const float* left, auto row, auto step, const float* right, int n) {
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
    struct One { enum { value = 1 }; };
    struct Panel { enum { value = PANEL }; };
    auto panels = [](long long columns) -> int { return (int)((columns + PANEL - 1) / PANEL); };
"""
