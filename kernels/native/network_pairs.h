// Adjoint of a small multilayer perceptron whose factors are rounded to bfloat16. Sums stay in float32.
//
// Two bfloat16 factors of a sum share 32 bits, so that one instruction of processors that have it adds two products.
// Gradients are stored twice: paired by columns, as the adjoint of the values reads them (columns j and j + LANES of a
// strip), and paired by rows, as that of the weights does.
#pragma once
#include "network_tiles.h"
#include "network_zeros.h"
#include "shuffles.h"

typedef unsigned vp __attribute__((vector_size(LANES * 4)));
typedef unsigned vpu __attribute__((vector_size(LANES * 4), aligned(4)));

// Round to the nearest bfloat16, ties to even; it is in the lower half. A NaN stays one.
static inline vp rounded(vn value) {
#if defined(__AVX512BF16__)
    typedef __bf16 halves __attribute__((vector_size(LANES * 2)));
    typedef unsigned short shorts __attribute__((vector_size(LANES * 2)));
    return __builtin_convertvector((shorts) __builtin_convertvector(value, halves), vp);
#else
    const vp bits = (vp)value, up = bits + 0x7fffu + (bits >> 16 & 1u);
    return (value == value ? up : bits | 0x400000u) >> 16;
#endif
}

// Round two numbers; the first is in the lower half of the result.
static inline vp paired(vn first, vn second) { return rounded(first) | rounded(second) << 16; }

static inline vn lower(vp pair) { return (vn)(pair << 16); }
static inline vn upper(vp pair) { return (vn)(pair & 0xffff0000u); }

// Return sum + the products of the upper and of the lower halves, in this order.
static inline vn add_products(vn sum, vp a, vp b) {
    FUSE_WITHIN_EXPRESSIONS
#if defined(__AVX512BF16__)
    typedef __bf16 halves __attribute__((vector_size(64)));
    return __builtin_ia32_dpbf16ps_512(sum, (halves)a, (halves)b);
#else
    const vn first = sum + upper(a) * upper(b);
    return first + lower(a) * lower(b);
#endif
}

// The products of two pairs, as a type.
struct Pairs {
    typedef vp row;
    typedef vpu unaligned;
    __attribute__((always_inline)) static vn add(vn sum, unsigned a, vp b) { return add_products(sum, vp{} + a, b); }
};

// Return a function like ``accumulation`` in network_panels.h for n pairs of both factors.
static inline auto pair_accumulation() {
    return [](auto& sums, const unsigned* left, auto row, auto step, const unsigned* right, int n) {
        vn acc[ROWS][VECTORS];
#pragma clang loop unroll(full)
        for (int r = 0; r < ROWS; ++r)
#pragma clang loop unroll(full)
            for (int v = 0; v < VECTORS; ++v) acc[r][v] = sums[r][v];
        for (const unsigned* end = right + n * PANEL; right < end; right += PANEL, left += step.value) {
            vp b[VECTORS];
#pragma clang loop unroll(full)
            for (int v = 0; v < VECTORS; ++v) b[v] = *(const vpu*)(right + v * LANES);
#pragma clang loop unroll(full)
            for (int r = 0; r < ROWS; ++r) {
                const vp a = vp{} + left[r * row.value];
#pragma clang loop unroll(full)
                for (int v = 0; v < VECTORS; ++v) acc[r][v] = add_products(acc[r][v], a, b[v]);
            }
        }
#pragma clang loop unroll(full)
        for (int r = 0; r < ROWS; ++r)
#pragma clang loop unroll(full)
            for (int v = 0; v < VECTORS; ++v) sums[r][v] = acc[r][v];
    };
}

struct HalfPanel {
    enum { value = PAIRS };
};

// Store two vectors of a row as pairs of columns: of a strip that begins at column c.
static inline void store_columns(unsigned* row, int c, vn first, vn second) {
    *(vpu*)(row + c / 2) = paired(first, second);
}

// Pack one panel of a layer's weights for the adjoint of the layer before: pair (j, j + LANES), column k.
static inline void pack_panel_pairs(
    int layer, int panel, const wp::array_t<wp::int64>& table, wp::array_t<int>& packed
) {
    const long long* own = (const long long*)table.data + (long long)layer * TABLE_COLUMNS;
    const int out = (int)own[OUTPUTS], inputs = (int)own[INPUTS], in = inputs + (int)own[HIDDEN];
    if (own[PACKED_ADJOINT] < 0 || panel >= panels(own[HIDDEN])) return;
    unsigned* to = (unsigned*)packed.data + own[PACKED_ADJOINT] / 2 + (long long)panel * panels(out) * PAIRS * PANEL;
    const float* from = (const float*)own[WEIGHTS] + inputs + (long long)panel * PANEL;
    for (int s = 0; s < panels(out) * PANEL; s += STRIP)
        for (int j = s; j < s + LANES; ++j, to += PANEL)
            for (int c = 0; c < PANEL; c += LANES) {
                vn first = {}, second = {};
                if (j < out) first = *(const vnu*)(from + (long long)j * in + c);
                if (j + LANES < out) second = *(const vnu*)(from + (long long)(j + LANES) * in + c);
                *(vpu*)(to + c) = paired(first, second);
            }
}

// Propagate the gradients of a block of rows back through all layers, and pair the rows of gradients, hidden values and
// inputs for the adjoint of the weights. ``columns`` holds the gradients of two layers.
WHOLE_REGISTERS static inline void network_block_adjoint_pairs(
    int block, int size, int first, int tiles, const wp::array_t<wp::int64>& table, const wp::array_t<int>& packed,
    const wp::array_t<int>& finite, const wp::array_t<float>& inputs, const wp::array_t<float>& hidden,
    const wp::array_t<float>& v_out, wp::array_t<int>& columns, wp::array_t<int>& input_rows,
    wp::array_t<int>& hidden_rows, wp::array_t<int>& v_rows
) {
    const auto accumulate = pair_accumulation();
    const auto accumulate_listed = listed_accumulation();
    const auto find = columns_of();
    NonzeroColumns read[BLOCK_TILES];
    const int layers = table.shape.dims[0], rows = hidden.shape.dims[1], own_rows = columns.shape.dims[1];
    const int count = v_out.shape.dims[0] - first, most = rows - first < own_rows ? rows - first : own_rows;
    const int begin = block * size, end = begin + size < most ? begin + size : most, outputs = v_out.shape.dims[1];
    const long long width = hidden.shape.dims[2], plane = rows * width, own_plane = own_rows * width / 2;
    for (int p = 0; p < inputs.shape.dims[0]; ++p)
        for (int i = begin; i < end; i += 2)
            for (int c = 0; c < PANEL; c += LANES) {
                const float* from = inputs.data + ((long long)p * rows + first + i) * PANEL + c;
                unsigned* to = (unsigned*)input_rows.data + ((long long)p * own_rows + i) * PAIRS + c;
                *(vpu*)to = paired(*(const vnu*)from, *(const vnu*)(from + PANEL));
            }
    for (int p = 0; p < panels(outputs); ++p)
        for (int i = begin; i < end; i += 2) {
            float v[2][PANEL] = {};
            for (int r = 0; r < 2 && i + r < count; ++r)
                for (int j = 0; j < PANEL && p * PANEL + j < outputs; ++j)
                    v[r][j] = v_out.data[(long long)(first + i + r) * outputs + p * PANEL + j];
            unsigned* by_columns =
                (unsigned*)columns.data + own_plane * (layers - 1 & 1) + ((long long)p * own_rows + i) * PAIRS;
            unsigned* by_rows =
                (unsigned*)v_rows.data + own_plane * (layers - 1) + ((long long)p * own_rows + i) * PAIRS;
            for (int c = 0; c < PANEL; c += LANES) *(vpu*)(by_rows + c) = paired(*(vnu*)&v[0][c], *(vnu*)&v[1][c]);
            for (int r = 0; r < 2; ++r)
                for (int c = 0; c < PANEL; c += STRIP)
                    store_columns(by_columns + r * PAIRS, c, *(vnu*)&v[r][c], *(vnu*)&v[r][c + LANES]);
        }
    alignas(64) float zeros[PANEL * PANEL] = {}, products[PANEL * PANEL];
    // Return the gradients of a panel's columns, for ROWS rows from i on, before the ReLU.
    auto multiply = [&](auto& acc, const unsigned* from, const unsigned* right, int reads, int i, bool listed) {
        for (int r = 0; r < ROWS; ++r)
            for (int v = 0; v < VECTORS; ++v)
                acc[r][v] = tiles ? *(vnu*)(products + (i - begin + r) * PANEL + v * LANES) : vn{};
        if (tiles) return;
        const NonzeroColumns& columns = read[(i - begin) / ROWS];
        if (listed && columns.worth_reading(reads * PAIRS)) {
            const unsigned* left = from + (long long)i * PAIRS;
            accumulate_listed(acc, left, HalfPanel(), right, columns, Pairs());
            return;
        }
        for (int k = 0; k < reads; ++k) {
            const unsigned* left = from + ((long long)k * own_rows + i) * PAIRS;
            accumulate(acc, left, HalfPanel(), One(), right + (long long)k * PAIRS * PANEL, PAIRS);
        }
    };
    for (int l = layers - 1; l > 0; --l) {
        const long long* own = (const long long*)table.data + (long long)l * TABLE_COLUMNS;
        const int reads = panels(own[OUTPUTS]);
        const unsigned* from = (unsigned*)columns.data + own_plane * (l & 1);
        const bool listed = !tiles && may_leave_out(finite, l, reads * PAIRS);
        for (int i = begin; i < end && listed; i += ROWS)
            find(
                read[(i - begin) / ROWS], from + (long long)i * PAIRS, (long long)own_rows * PAIRS, reads, HalfPanel()
            );
        for (int p = 0; p < panels(own[HIDDEN]); ++p)
            for (int c = 0; c < PANEL; c += STRIP) {
                const unsigned* right =
                    (unsigned*)packed.data + own[PACKED_ADJOINT] / 2 + (long long)p * reads * PAIRS * PANEL + c;
                if (tiles) {
                    const Tiles registers = {};
                    registers.begin(zeros);
                    for (int k = 0; k < reads; ++k)
                        registers.add(
                            from + ((long long)k * own_rows + begin) * PAIRS, right + (long long)k * PAIRS * PANEL
                        );
                    registers.end(products);
                }
                for (int i = begin; i < end; i += ROWS) {
                    vn acc[ROWS][VECTORS], h[ROWS][VECTORS];
                    multiply(acc, from, right, reads, i, listed);
                    const float* value = hidden.data + plane * (l - 1) + ((long long)p * rows + first + i) * PANEL + c;
                    for (int r = 0; r < ROWS; ++r)
                        for (int v = 0; v < VECTORS; ++v) {
                            h[r][v] = *(const vnu*)(value + r * PANEL + v * LANES);
                            acc[r][v] = h[r][v] <= 0.0f ? vn{} : acc[r][v];
                        }
                    const long long at = ((long long)p * own_rows + i) * PAIRS;
                    unsigned* by_columns = (unsigned*)columns.data + own_plane * (l - 1 & 1) + at;
                    unsigned* by_rows = (unsigned*)v_rows.data + own_plane * (l - 1) + at + c;
                    unsigned* values = (unsigned*)hidden_rows.data + own_plane * (l - 1) + at + c;
                    for (int r = 0; r < ROWS; ++r) store_columns(by_columns + r * PAIRS, c, acc[r][0], acc[r][1]);
                    for (int r = 0; r < ROWS; r += 2)
                        for (int v = 0; v < VECTORS; ++v) {
                            *(vpu*)(by_rows + r * PAIRS + v * LANES) = paired(acc[r][v], acc[r + 1][v]);
                            *(vpu*)(values + r * PAIRS + v * LANES) = paired(h[r][v], h[r + 1][v]);
                        }
                }
            }
    }
}

// Copy the part of 32 x 32 numbers that exists between two matrices with ``from_stride`` and ``to_stride`` columns.
static inline void copy_part(
    const float* from, long long from_stride, float* to, long long to_stride, int rows, int columns
) {
    for (int j = 0; j < rows; ++j)
        for (int c = 0; c < columns; ++c) to[j * to_stride + c] = from[j * from_stride + c];
}

// Turn the columns of rows of pairs into rows, 16 pairs at a time: what a tile of a left factor holds.
static inline void turn_pairs(const unsigned* v, int pairs, unsigned* turned) {
    for (int i = 0; i < pairs; i += SIDE)
        for (int half = 0; half < PANEL; half += SIDE, turned += SIDE * SIDE) {
            vf rows[SIDE];
            for (int k = 0; k < SIDE; ++k)
                rows[k] = i + k < pairs ? load((const float*)v + (i + k) * PANEL + half, 16) : vf{};
            transpose(rows);
            __builtin_memcpy(turned, rows, sizeof(rows));
        }
}

// Compute 32 x 32 gradients of weights by tiles: the sums over pairs of rows of the turned v times x, PANEL apart. If
// ``first``, the sums continue those at ``gradient``, of which ``rows`` x ``columns`` exist.
static inline void tiled_gradients(
    const unsigned* turned, const unsigned* x, int pairs, int first, float* gradient, long long stride, int rows,
    int columns
) {
    alignas(64) float sums[PANEL * PANEL] = {};
    alignas(64) unsigned rest[SIDE * PANEL];
    if (first) copy_part(gradient, stride, sums, PANEL, rows, columns);
    const Tiles registers = {};
    registers.begin(sums);
    for (int i = 0; i < pairs; i += SIDE) {
        const int own = pairs - i < SIDE ? pairs - i : SIDE;
        const unsigned* right = x + (long long)i * PANEL;
        if (own < SIDE) {  // what lies behind may be anything
            __builtin_memset(rest, 0, sizeof(rest));
            __builtin_memcpy(rest, right, own * PANEL * sizeof(unsigned));
            right = rest;
        }
        registers.add(turned + (long long)i * PANEL, right);
    }
    registers.end(sums);
    copy_part(sums, PANEL, gradient, stride, rows, columns);
}

// Compute the gradients of the weights [out, in] and biases of one panel of a layer's outputs. The sums over the rows
// of ``v_rows`` continue those over the rows before ``first``.
WHOLE_REGISTERS static inline void network_panel_adjoint_pairs(
    int layer, int panel, int part, int parts, int first, int count, int tiles, const wp::array_t<wp::int64>& table,
    const wp::array_t<int>& input_rows, const wp::array_t<int>& hidden_rows, const wp::array_t<int>& v_rows
) {
    const auto accumulate = pair_accumulation();
    const long long* own = (const long long*)table.data + (long long)layer * TABLE_COLUMNS;
    const int outputs = (int)own[OUTPUTS], own_rows = 2 * v_rows.shape.dims[1], pairs = (count + 1) / 2;
    if (panel >= panels(outputs)) return;
    const long long own_plane = (long long)v_rows.shape.dims[1] * v_rows.shape.dims[2];
    const int from_inputs = (int)own[INPUTS], in = from_inputs + (int)own[HIDDEN];
    float* gradient = (float*)own[WEIGHTS_ADJOINT];
    const unsigned* v = (unsigned*)v_rows.data + own_plane * layer + (long long)panel * own_rows * PAIRS;
    const int n_out = outputs - panel * PANEL < PANEL ? outputs - panel * PANEL : PANEL;
    if (part == 0) {
        float sums[PANEL] = {};
        float* to = gradient + (long long)outputs * in + panel * PANEL;
        if (first)
            for (int j = 0; j < n_out; ++j) sums[j] = to[j];
        for (int i = 0; i < pairs; ++i)
            for (int c = 0; c < PANEL; c += LANES) {
                const vp pair = *(const vpu*)(v + i * PANEL + c);
                *(vnu*)(sums + c) = *(vnu*)(sums + c) + lower(pair) + upper(pair);
            }
        for (int j = 0; j < n_out; ++j) to[j] = sums[j];
    }
    const int before = panels(from_inputs), all = before + panels(own[HIDDEN]);
    alignas(64) unsigned turned[NETWORK_ADJOINT_ROWS / 2 * PANEL];
    if (tiles && part < all) turn_pairs(v, pairs, turned);
    for (int q = part; q < all; q += parts) {
        const bool of_inputs = q < before;
        const unsigned* x = of_inputs ? (unsigned*)input_rows.data + (long long)q * own_rows * PAIRS
                                      : (unsigned*)hidden_rows.data + own_plane * (layer - 1) +
                                            (long long)(q - before) * own_rows * PAIRS;
        const int column = of_inputs ? q * PANEL : from_inputs + (q - before) * PANEL;
        const int n = of_inputs && from_inputs - column < PANEL ? from_inputs - column : PANEL;
        if (tiles) {
            tiled_gradients(turned, x, pairs, first, gradient + (long long)panel * PANEL * in + column, in, n_out, n);
            continue;
        }
        for (int j = 0; j < n_out; j += ROWS)
            for (int c = 0; c < n; c += STRIP) {
                vn acc[ROWS][VECTORS];
                for (int r = 0; r < ROWS; ++r)
                    for (int u = 0; u < VECTORS; ++u) acc[r][u] = vn{};
                float* to = gradient + (long long)(panel * PANEL + j) * in + column + c;
                if (first) read_tile()(acc, to, in, n_out - j, n - c);
                accumulate(acc, v + j, One(), Panel(), x + c, pairs);
                write_tile()(acc, to, in, n_out - j, n - c);
            }
    }
}
