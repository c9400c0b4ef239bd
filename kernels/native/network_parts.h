// Evaluation of a small multilayer perceptron by the tile registers of AMX, in the precision of float32.
//
// A number is the sum of three bfloat16 parts, which have the first, the second and the last eight of its 24 bits. Of
// the nine products of the parts of two numbers, six are larger than the rounding of float32 (Henry, Tang and Heinecke
// 2019). Subnormal parts count as zero. A row's values depend neither on other rows nor on how the rows are cut into
// blocks.
#pragma once
#include "network_tiles.h"
#include "shuffles.h"

#if defined(__AMX_BF16__) && defined(__AVX512F__)
enum { BFLOAT16_PARTS = 3 };

// Cut two vectors into parts, and pair the parts; the first is in the lower halves.
static inline void split(vf first, vf second, vu* parts) {
    for (int part = 0; part < BFLOAT16_PARTS; ++part) {
        const vu a = (vu)first & 0xffff0000u, b = (vu)second & 0xffff0000u;
        parts[part] = a >> 16 | b;
        first -= (vf)a;
        second -= (vf)b;
    }
}

// Cut a row of a panel into parts, ``apart`` numbers apart.
static inline void split_row(vf first, vf second, unsigned* to, long long apart) {
    vu parts[BFLOAT16_PARTS];
    split(first, second, parts);
    for (int part = 0; part < BFLOAT16_PARTS; ++part) store((float*)(to + part * apart), (vf)parts[part], SIDE);
}

// Cut the weights of one panel of a layer's outputs into parts: for each panel of what the layer reads, pair (k, k +
// 16), column j. This takes less time than to read them from memory after another kernel has cut them.
static inline void weights_in_parts(const long long* own, int panel, unsigned* to) {
    const int inputs = (int)own[INPUTS], hidden = (int)own[HIDDEN], out = (int)own[OUTPUTS], in = inputs + hidden;
    const int reads = panels(inputs) + panels(hidden);
    const long long apart = (long long)reads * PAIRS * PANEL;
    for (int q = 0; q < reads; ++q) {
        const bool of_inputs = q < panels(inputs);
        const int column = of_inputs ? q * PANEL : inputs + (q - panels(inputs)) * PANEL;
        const int n = (of_inputs ? inputs : in) - column;
        for (int half = 0; half < PANEL; half += SIDE) {
            vf turned[BFLOAT16_PARTS][SIDE];
            for (int j = 0; j < SIDE; ++j) {
                const int row = panel * PANEL + half + j;
                const float* from = (const float*)own[WEIGHTS] + (long long)row * in + column;
                vu parts[BFLOAT16_PARTS] = {};
                if (row < out)
                    split(
                        load(from, n < SIDE ? n : SIDE),
                        n > SIDE ? load(from + SIDE, n < PANEL ? n - SIDE : SIDE) : vf{}, parts
                    );
                for (int part = 0; part < BFLOAT16_PARTS; ++part) turned[part][j] = (vf)parts[part];
            }
            for (int part = 0; part < BFLOAT16_PARTS; ++part) {
                transpose(turned[part]);
                for (int k = 0; k < SIDE; ++k)
                    store((float*)(to + part * apart + (q * SIDE + k) * PANEL + half), turned[part][k], SIDE);
            }
        }
    }
}

// Add the product of 32 rows of a panel and of a panel of weights, whose parts are ``rows_apart`` and ``weights_apart``
// numbers apart.
static inline void add_parts(
    const Tiles& registers, const unsigned* rows, long long rows_apart, const unsigned* weights, long long weights_apart
) {
    registers.read_left(rows);
    registers.read_right(weights + 2 * weights_apart);
    registers.add();
    registers.read_right(weights + weights_apart);
    registers.add();
    registers.read_right(weights);
    registers.add();
    registers.read_left(rows + 2 * rows_apart);
    registers.add();
    registers.read_left(rows + rows_apart);
    registers.add();
    registers.read_right(weights + weights_apart);
    registers.add();
}

// Take a block of rows through all layers. Scratch has slots for blocks that run at the same time, and ``hidden_parts``
// has room for two layers.
WHOLE_REGISTERS static inline void network_block_parts(
    int block, int size, int keep, const wp::array_t<wp::int64>& table, const wp::array_t<float>& inputs,
    wp::array_t<int>& input_parts, wp::array_t<int>& hidden_parts, wp::array_t<int>& weight_parts,
    wp::array_t<float>& hidden, wp::array_t<float>& out
) {
    const int layers = table.shape.dims[0], rows = inputs.shape.dims[1];
    const int begin = block * size, end = begin + size < rows ? begin + size : rows, count = out.shape.dims[0];
    const long long slot = block % weight_parts.shape.dims[0], panel_size = (long long)size * SIDE;
    const long long inputs_apart = inputs.shape.dims[0] * panel_size;
    const long long hidden_apart = hidden_parts.shape.dims[1] / (2 * BFLOAT16_PARTS);
    unsigned* own_inputs = (unsigned*)input_parts.data + slot * input_parts.shape.dims[1];
    unsigned* own_hidden = (unsigned*)hidden_parts.data + slot * hidden_parts.shape.dims[1];
    unsigned* weights = (unsigned*)weight_parts.data + slot * weight_parts.shape.dims[1];
    for (int q = 0; q < inputs.shape.dims[0]; ++q)
        for (int i = begin; i < end; ++i) {
            const float* from = inputs.data + ((long long)q * rows + i) * PANEL;
            unsigned* to = own_inputs + q * panel_size + (i - begin) * SIDE;
            split_row(load(from, SIDE), load(from + SIDE, SIDE), to, inputs_apart);
        }
    const Tiles registers = {};
    alignas(64) float start[PANEL * PANEL], sums[PANEL * PANEL];
    for (int l = 0; l < layers; ++l) {
        const long long* own = (const long long*)table.data + (long long)l * TABLE_COLUMNS;
        const float* bias = (const float*)own[BIAS];
        const int from_inputs = panels(own[INPUTS]), reads = from_inputs + panels(own[HIDDEN]);
        const int outputs = (int)own[OUTPUTS];
        const long long apart = (long long)reads * PAIRS * PANEL;
        const unsigned* before = own_hidden + BFLOAT16_PARTS * hidden_apart * (l - 1 & 1);
        unsigned* after = own_hidden + BFLOAT16_PARTS * hidden_apart * (l & 1);
        for (int p = 0; p < panels(outputs); ++p) {
            weights_in_parts(own, p, weights);
            for (int r = 0; r < PANEL; ++r)
                for (int c = 0; c < PANEL; ++c)
                    start[r * PANEL + c] = p * PANEL + c < outputs ? bias[p * PANEL + c] : 0.0f;
            for (int i = begin; i < end; i += PANEL) {
                registers.begin(start);
                for (int k = 0; k < reads; ++k) {
                    const bool of_inputs = k < from_inputs;
                    const unsigned* from = of_inputs ? own_inputs : before;
                    const int panel = of_inputs ? k : k - from_inputs;
                    add_parts(
                        registers, from + panel * panel_size + (i - begin) * SIDE,
                        of_inputs ? inputs_apart : hidden_apart, weights + k * PAIRS * PANEL, apart
                    );
                }
                registers.end(sums);
                const int own_rows = end - i < PANEL ? end - i : PANEL;
                if (l + 1 == layers) {
                    for (int r = 0; r < own_rows && i + r < count; ++r)
                        for (int c = 0; c < PANEL && p * PANEL + c < outputs; ++c)
                            out.data[(long long)(i + r) * outputs + p * PANEL + c] = sums[r * PANEL + c];
                    continue;
                }
                for (int r = 0; r < own_rows; ++r) {
                    vf value[2];
                    for (int v = 0; v < 2; ++v) {
                        const vf sum = load(sums + r * PANEL + v * SIDE, SIDE);
                        value[v] = sum < 0.0f ? vf{} : sum;  // NaN is kept
                    }
                    split_row(value[0], value[1], after + p * panel_size + (i - begin + r) * SIDE, hidden_apart);
                    if (!keep) continue;
                    const long long plane = (long long)rows * hidden.shape.dims[2];
                    float* to = hidden.data + plane * l + ((long long)p * rows + i + r) * PANEL;
                    for (int v = 0; v < 2; ++v) store(to + v * SIDE, value[v], SIDE);
                }
            }
        }
    }
}
#else  // never called
static inline void network_block_parts(
    int, int, int, const wp::array_t<wp::int64>&, const wp::array_t<float>&, wp::array_t<int>&, wp::array_t<int>&,
    wp::array_t<int>&, wp::array_t<float>&, wp::array_t<float>&
) {}
#endif
