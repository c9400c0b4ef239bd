// Adjoint of a small multilayer perceptron: gradients of its hidden values, inputs and weights.
//
// v_hidden[l] is the gradient of layer l's values before the ReLU, in panels, for the rows from ``first`` on.
#pragma once
#include "network_zeros.h"

WHOLE_REGISTERS static inline void network_block_adjoint(
    int block, int size, int first, const wp::array_t<wp::int64>& table, const wp::array_t<float>& packed,
    const wp::array_t<int>& finite, const wp::array_t<float>& hidden, const wp::array_t<float>& v_out,
    wp::array_t<float>& v_hidden
) {
    FUSE_WITHIN_EXPRESSIONS
    const auto accumulate = accumulation();
    const auto accumulate_listed = listed_accumulation();
    const auto find = columns_of();
    NonzeroColumns read[BLOCK_TILES];
    const int layers = table.shape.dims[0], rows = hidden.shape.dims[1];
    const long long own_rows = v_hidden.shape.dims[1];
    const int count = v_out.shape.dims[0] - first, most = rows - first < own_rows ? rows - first : own_rows;
    const int begin = block * size, end = begin + size < most ? begin + size : most;
    const long long width = hidden.shape.dims[2], plane = rows * width, own_plane = own_rows * width;
    const int outputs = v_out.shape.dims[1];
    for (int p = 0; p < panels(outputs); ++p)
        for (int i = begin; i < end; ++i)
            for (int j = 0; j < PANEL; ++j) {
                const int column = p * PANEL + j;
                v_hidden.data[own_plane * (layers - 1) + ((long long)p * own_rows + i) * PANEL + j] =
                    i < count && column < outputs ? v_out.data[(long long)(first + i) * outputs + column] : 0.0f;
            }
    for (int l = layers - 1; l > 0; --l) {
        const long long* own = (const long long*)table.data + (long long)l * TABLE_COLUMNS;
        const int reads = (int)own[OUTPUTS];
        const float* from = v_hidden.data + own_plane * l;
        const bool listed = may_leave_out(finite, l, panels(reads) * PANEL);
        for (int i = begin; i < end && listed; i += ROWS)
            find(read[(i - begin) / ROWS], from + (long long)i * PANEL, own_rows * PANEL, panels(reads), Panel());
        for (int p = 0; p < panels(own[HIDDEN]); ++p)
            for (int c = 0; c < PANEL; c += STRIP) {
                const float* right = packed.data + own[PACKED_ADJOINT] + (long long)p * reads * PANEL + c;
                for (int i = begin; i < end; i += ROWS) {
                    vn acc[ROWS][VECTORS];
                    for (int r = 0; r < ROWS; ++r)
                        for (int v = 0; v < VECTORS; ++v) acc[r][v] = vn{};
                    const NonzeroColumns& columns = read[(i - begin) / ROWS];
                    if (listed && columns.worth_reading(reads)) {
                        const float* left = from + (long long)i * PANEL;
                        accumulate_listed(acc, left, Panel(), right, columns, Numbers());
                    } else
                        for (int k = 0; k < reads; k += PANEL) {
                            const int n = reads - k < PANEL ? reads - k : PANEL;
                            const float* left = from + (long long)k * own_rows + (long long)i * PANEL;
                            accumulate(acc, left, Panel(), One(), right + (long long)k * PANEL, n);
                        }
                    const float* value = hidden.data + plane * (l - 1) + ((long long)p * rows + first + i) * PANEL + c;
                    float* to = v_hidden.data + own_plane * (l - 1) + ((long long)p * own_rows + i) * PANEL + c;
                    for (int r = 0; r < ROWS; ++r)
                        for (int v = 0; v < VECTORS; ++v) {
                            const vn h = *(const vnu*)(value + r * PANEL + v * LANES);
                            *(vnu*)(to + r * PANEL + v * LANES) = h <= 0.0f ? vn{} : acc[r][v];
                        }
                }
            }
    }
}

// Sum the gradient of the inputs over all layers that read them, first to last.
WHOLE_REGISTERS static inline void network_inputs_block_adjoint(
    int block, int size, int first, const wp::array_t<wp::int64>& table, const wp::array_t<float>& packed,
    const wp::array_t<float>& v_hidden, wp::array_t<float>& v_inputs
) {
    FUSE_WITHIN_EXPRESSIONS
    const auto accumulate = accumulation();
    const int layers = table.shape.dims[0], rows = v_hidden.shape.dims[1], columns = v_inputs.shape.dims[1];
    const int count = v_inputs.shape.dims[0] - first;
    const int begin = block * size, end = begin + size < rows ? begin + size : rows;
    const long long plane = (long long)rows * v_hidden.shape.dims[2];
    for (int p = 0; p < panels(columns); ++p)
        for (int c = 0; c < PANEL; c += STRIP)
            for (int i = begin; i < end; i += ROWS) {
                vn acc[ROWS][VECTORS];
                for (int r = 0; r < ROWS; ++r)
                    for (int v = 0; v < VECTORS; ++v) acc[r][v] = vn{};
                for (int l = 0; l < layers; ++l) {
                    const long long* own = (const long long*)table.data + (long long)l * TABLE_COLUMNS;
                    if (own[PACKED_INPUTS] < 0) continue;
                    const int reads = (int)own[OUTPUTS];
                    const float* right = packed.data + own[PACKED_INPUTS] + (long long)p * reads * PANEL + c;
                    for (int k = 0; k < reads; k += PANEL) {
                        const int n = reads - k < PANEL ? reads - k : PANEL;
                        const float* left = v_hidden.data + plane * l + (long long)k * rows + (long long)i * PANEL;
                        accumulate(acc, left, Panel(), One(), right + (long long)k * PANEL, n);
                    }
                }
                for (int r = 0; r < ROWS && i + r < count; ++r)
                    for (int v = 0; v < VECTORS; ++v) {
                        const int column = p * PANEL + c + v * LANES;
                        float* to = v_inputs.data + (long long)(first + i + r) * columns + column;
                        if (column + LANES <= columns)
                            *(vnu*)to = acc[r][v];
                        else
                            for (int j = 0; column + j < columns; ++j) to[j] = acc[r][v][j];
                    }
            }
}

// Compute the weight gradients [out, in] and the bias gradients of one panel of a layer's outputs. The sums over the
// rows of ``v_hidden`` continue those over the rows before ``first``.
WHOLE_REGISTERS static inline void network_panel_adjoint(
    int layer, int panel, int part, int parts, int first, int count, const wp::array_t<wp::int64>& table,
    const wp::array_t<float>& inputs, const wp::array_t<float>& hidden, const wp::array_t<float>& v_hidden
) {
    FUSE_WITHIN_EXPRESSIONS
    const auto accumulate = accumulation();
    const long long* own = (const long long*)table.data + (long long)layer * TABLE_COLUMNS;
    const int outputs = (int)own[OUTPUTS], rows = hidden.shape.dims[1], own_rows = v_hidden.shape.dims[1];
    if (panel >= panels(outputs)) return;
    const long long width = hidden.shape.dims[2], plane = rows * width, own_plane = own_rows * width;
    const int from_inputs = (int)own[INPUTS], in = from_inputs + (int)own[HIDDEN];
    float* gradient = (float*)own[WEIGHTS_ADJOINT];
    const float* v = v_hidden.data + own_plane * layer + (long long)panel * own_rows * PANEL;
    const int n_out = outputs - panel * PANEL < PANEL ? outputs - panel * PANEL : PANEL;
    if (part == 0) {
        float sums[PANEL] = {};
        float* to = gradient + (long long)outputs * in + panel * PANEL;
        if (first)
            for (int j = 0; j < n_out; ++j) sums[j] = to[j];
        for (int i = 0; i < count; ++i)
            for (int j = 0; j < PANEL; ++j) sums[j] += v[i * PANEL + j];
        for (int j = 0; j < n_out; ++j) to[j] = sums[j];
    }
    const int before = panels(from_inputs), all = before + panels(own[HIDDEN]);
    for (int q = part; q < all; q += parts) {
        const bool of_inputs = q < before;
        const float* x = of_inputs
                             ? inputs.data + ((long long)q * rows + first) * PANEL
                             : hidden.data + plane * (layer - 1) + ((long long)(q - before) * rows + first) * PANEL;
        const int column = of_inputs ? q * PANEL : from_inputs + (q - before) * PANEL;
        const int n = of_inputs && from_inputs - column < PANEL ? from_inputs - column : PANEL;
        for (int j = 0; j < n_out; j += ROWS)
            for (int c = 0; c < n; c += STRIP) {
                vn acc[ROWS][VECTORS];
                for (int r = 0; r < ROWS; ++r)
                    for (int u = 0; u < VECTORS; ++u) acc[r][u] = vn{};
                float* to = gradient + (long long)(panel * PANEL + j) * in + column + c;
                if (first) read_tile()(acc, to, in, n_out - j, n - c);
                accumulate(acc, v + j, One(), Panel(), x + c, count);
                write_tile()(acc, to, in, n_out - j, n - c);
            }
    }
}
