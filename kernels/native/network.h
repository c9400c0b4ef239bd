// A small multilayer perceptron: packing of its weights and inputs, and its evaluation.
#pragma once
#include "network_tiles.h"
#include "network_zeros.h"

static inline void pair_products(wp::array_t<int>& found) {
#if defined(__AVX512BF16__)
    found.data[0] = 1 + HAS_TILES;
#else
    found.data[0] = 0;
#endif
}

// Return 1 if all numbers are finite.
static inline int all_finite(const float* numbers, long long count) {
    int all = 1;
    for (long long i = 0; i < count; ++i) all &= __builtin_fabsf(numbers[i]) < __builtin_inff();
    return all;
}

// Pack one panel of a layer's weights, in the layout that each of its products reads; for the adjoint of the layer
// before only if asked.
static inline void pack_panel(
    int layer, int panel, int adjoint, const wp::array_t<wp::int64>& table, wp::array_t<float>& packed,
    wp::array_t<int>& finite
) {
    const long long* own = (const long long*)table.data + (long long)layer * TABLE_COLUMNS;
    const float* weights = (const float*)own[WEIGHTS];
    const int in = (int)(own[INPUTS] + own[HIDDEN]), out = (int)own[OUTPUTS];
    int& own_finite = finite.data[(long long)layer * finite.shape.dims[1] + panel];
    own_finite = 1;
    if (panel < panels(out)) {  // row k, column j of a panel: weights[j, k]
        float* to = packed.data + own[PACKED] + (long long)panel * in * PANEL;
        const int n = out - panel * PANEL < PANEL ? out - panel * PANEL : PANEL;
        const float* from = weights + (long long)panel * PANEL * in;
        own_finite = all_finite(from, (long long)n * in);
        for (int k = 0; k < in; ++k)
            for (int j = 0; j < PANEL; ++j) to[k * PANEL + j] = j < n ? from[(long long)j * in + k] : 0.0f;
    }
    if (own[PACKED_INPUTS] >= 0 && panel < panels(own[INPUTS])) {  // row j, column k: weights[j, k]
        float* to = packed.data + own[PACKED_INPUTS] + (long long)panel * out * PANEL;
        const int n = own[INPUTS] - panel * PANEL < PANEL ? own[INPUTS] - panel * PANEL : PANEL;
        const float* from = weights + (long long)panel * PANEL;
        for (int j = 0; j < out; ++j)
            for (int k = 0; k < PANEL; ++k) to[j * PANEL + k] = k < n ? from[(long long)j * in + k] : 0.0f;
    }
    if (adjoint && own[PACKED_ADJOINT] >= 0 &&
        panel < panels(own[HIDDEN])) {  // row j, column k: weights[j, inputs + k]
        float* to = packed.data + own[PACKED_ADJOINT] + (long long)panel * out * PANEL;
        const float* from = weights + own[INPUTS] + (long long)panel * PANEL;
        for (int j = 0; j < out; ++j) __builtin_memcpy(to + j * PANEL, from + (long long)j * in, PANEL * sizeof(float));
    }
}

// Write one row of the inputs: a position's columns, then a time's.
static inline void pack_row(
    int row, const wp::array_t<float>& where, const wp::array_t<float>& when, wp::array_t<float>& inputs
) {
    const int positions = where.shape.dims[0], wide = where.shape.dims[1], narrow = when.shape.dims[1];
    const int t = row / positions, rows = inputs.shape.dims[1];
    const bool there = t < when.shape.dims[0];  // false: padding of the last block
    const float* a = where.data + (long long)(row - t * positions) * wide;
    const float* b = when.data + (long long)t * narrow;
    for (int p = 0; p < inputs.shape.dims[0]; ++p) {
        float* to = inputs.data + ((long long)p * rows + row) * PANEL;
        if (there && (p + 1) * PANEL <= wide)
            __builtin_memcpy(to, a + p * PANEL, PANEL * sizeof(float));
        else
            for (int j = 0; j < PANEL; ++j) {
                const int c = p * PANEL + j;
                to[j] = there && c < wide + narrow ? (c < wide ? a[c] : b[c - wide]) : 0.0f;
            }
    }
}

// The sum that a tile of a layer's outputs begins with, in each row: the biases.
static inline auto biases() {
    return [](auto& start, const long long* layer, int first) {
        const float* bias = (const float*)layer[BIAS];
        for (int v = 0; v < (int)(sizeof(start) / sizeof(vn)); ++v)
            for (int j = 0; j < LANES; ++j) {
                const int column = first + v * LANES + j;
                start[v][j] = column < (int)layer[OUTPUTS] ? bias[column] : 0.0f;
            }
    };
}

// Sum, for a block of rows, what the first ``known`` columns of the inputs add to the biases of each layer that reads
// them.
WHOLE_REGISTERS static inline void network_block_sums(
    int block, int size, int known, const wp::array_t<wp::int64>& table, const wp::array_t<float>& packed,
    const wp::array_t<float>& inputs, wp::array_t<float>& sums
) {
    FUSE_WITHIN_EXPRESSIONS
    const auto accumulate = accumulation();
    const int rows = inputs.shape.dims[1];
    const int begin = block * size, end = begin + size < rows ? begin + size : rows;
    float* to = sums.data;
    for (int l = 0; l < table.shape.dims[0]; ++l) {
        const long long* own = (const long long*)table.data + (long long)l * TABLE_COLUMNS;
        if (!own[INPUTS]) continue;
        for (int p = 0; p < panels(own[OUTPUTS]); ++p)
            for (int c = 0; c < PANEL; c += STRIP) {
                const float* right = packed.data + own[PACKED] + (long long)p * (own[INPUTS] + own[HIDDEN]) * PANEL + c;
                vn start[VECTORS];
                biases()(start, own, p * PANEL + c);
                for (int i = begin; i < end; i += ROWS) {
                    vn acc[ROWS][VECTORS];
                    for (int r = 0; r < ROWS; ++r)
                        for (int v = 0; v < VECTORS; ++v) acc[r][v] = start[v];
                    for (int k = 0; k < known; k += PANEL) {
                        const float* left = inputs.data + (long long)k * rows + (long long)i * PANEL;
                        const int n = known - k < PANEL ? known - k : PANEL;
                        accumulate(acc, left, Panel(), One(), right + (long long)k * PANEL, n);
                    }
                    for (int r = 0; r < ROWS; ++r)
                        for (int v = 0; v < VECTORS; ++v)
                            *(vnu*)(to + ((long long)p * rows + i + r) * PANEL + c + v * LANES) = acc[r][v];
                }
            }
        to += (long long)rows * sums.shape.dims[2];
    }
}

// Take a block of rows through all layers. If ``known`` is not 0, ``sums`` holds what the first columns of the inputs
// add, and all rows share the other columns, in the only row of ``inputs``. ``order``, unless it is empty, holds the
// row of the outputs that a row belongs to.
WHOLE_REGISTERS static inline void network_block(
    int block, int size, int keep, int known, const wp::array_t<wp::int64>& table, const wp::array_t<float>& packed,
    const wp::array_t<int>& finite, const wp::array_t<float>& inputs, const wp::array_t<float>& sums,
    const wp::array_t<int>& order, wp::array_t<float>& hidden, wp::array_t<float>& out
) {
    FUSE_WITHIN_EXPRESSIONS
    const auto accumulate = accumulation();
    const auto accumulate_listed = listed_accumulation();
    const auto find = columns_of();
    NonzeroColumns read[BLOCK_TILES];
    const int layers = table.shape.dims[0], rows = hidden.shape.dims[1];
    const int begin = block * size, end = begin + size < rows ? begin + size : rows, count = out.shape.dims[0];
    const int width = hidden.shape.dims[2];
    const long long plane = (long long)rows * width;
    struct Shared {
        enum { value = 0 };
    };
    struct Full {
        enum { value = VECTORS };
    };
    struct Half {
        enum { value = 1 };
    };
    // List the columns that a layer reads of the layer before, for each tile of rows. Return whether that may be done.
    auto list = [&](int l, int columns) {
        if (!columns || !may_leave_out(finite, l, columns)) return false;
        const float* before = hidden.data + plane * (keep ? l - 1 : (l - 1) & 1);
        for (int i = begin; i < end; i += ROWS)
            find(
                read[(i - begin) / ROWS], before + (long long)i * PANEL, (long long)rows * PANEL, panels(columns),
                Panel()
            );
        return true;
    };
    // Return the number of layers before l that read the inputs.
    auto sums_before = [&](int l) {
        int number = 0;
        for (int m = 0; m < l; ++m) number += table.data[(long long)m * TABLE_COLUMNS + INPUTS] > 0;
        return number;
    };
    // Compute a strip of one or two vectors of a layer's outputs, for the rows of the block.
    auto tile = [&](auto vectors, int l, int p, int c, bool listed) {
        constexpr int V = decltype(vectors)::value;
        const long long* own = (const long long*)table.data + (long long)l * TABLE_COLUMNS;
        const int from_inputs = (int)own[INPUTS], from_hidden = (int)own[HIDDEN], outputs = (int)own[OUTPUTS];
        const float* before = hidden.data + plane * (keep ? l - 1 : (l - 1) & 1);
        float* after = hidden.data + plane * (keep ? l : l & 1);
        const float* right = packed.data + own[PACKED] + (long long)p * (from_inputs + from_hidden) * PANEL + c;
        const float* known_sums = known && from_inputs ? sums.data + plane * sums_before(l) : nullptr;
        vn start[V];
        biases()(start, own, p * PANEL + c);
        for (int i = begin; i < end; i += ROWS) {
            vn acc[ROWS][V];
            for (int r = 0; r < ROWS; ++r)
                for (int v = 0; v < V; ++v)
                    acc[r][v] = known_sums
                                    ? *(const vnu*)(known_sums + ((long long)p * rows + i + r) * PANEL + c + v * LANES)
                                    : start[v];
            if (known && from_inputs)
                accumulate(
                    acc, inputs.data + known, Shared(), One(), right + (long long)known * PANEL, from_inputs - known
                );
            for (int k = 0; k < from_inputs && !known; k += PANEL) {
                const int n = from_inputs - k < PANEL ? from_inputs - k : PANEL;
                const float* left = inputs.data + (long long)k * rows + (long long)i * PANEL;
                accumulate(acc, left, Panel(), One(), right + (long long)k * PANEL, n);
            }
            const float* b = right + (long long)from_inputs * PANEL;
            const NonzeroColumns& columns = read[(i - begin) / ROWS];
            if (listed && columns.worth_reading(from_hidden))
                accumulate_listed(acc, before + (long long)i * PANEL, Panel(), b, columns, Numbers());
            else
                for (int k = 0; k < from_hidden; k += PANEL) {
                    accumulate(acc, before + (long long)k * rows + (long long)i * PANEL, Panel(), One(), b, PANEL);
                    b += PANEL * PANEL;
                }
            if (l + 1 < layers) {
                float* to = after + (long long)p * PANEL * rows + (long long)i * PANEL + c;
                for (int r = 0; r < ROWS; ++r)
                    for (int v = 0; v < V; ++v)  // NaN is kept
                        *(vnu*)(to + r * PANEL + v * LANES) = acc[r][v] < 0.0f ? vn{} : acc[r][v];
                continue;
            }
            for (int r = 0; r < ROWS && i + r < count; ++r)
                for (int v = 0; v < V; ++v)
                    for (int j = 0; j < LANES; ++j) {
                        const int column = p * PANEL + c + v * LANES + j;
                        const long long row = order.shape.dims[0] ? order.data[i + r] : i + r;
                        if (column < outputs) out.data[row * outputs + column] = acc[r][v][j];
                    }
        }
    };
    for (int l = 0; l < layers; ++l) {
        const int outputs = (int)table.data[(long long)l * TABLE_COLUMNS + OUTPUTS];
        const bool listed = list(l, (int)table.data[(long long)l * TABLE_COLUMNS + HIDDEN]);
        for (int p = 0; p < panels(outputs); ++p)
            for (int c = 0; c < PANEL; c += STRIP) {
                if (p * PANEL + c >= outputs) break;
                // Half a tile is enough for the end of a narrow last layer.
                if (p * PANEL + c + LANES < outputs)
                    tile(Full(), l, p, c, listed);
                else
                    tile(Half(), l, p, c, listed);
            }
    }
}
