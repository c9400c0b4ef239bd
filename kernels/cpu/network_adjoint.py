"""Adjoint of a small multilayer perceptron on a CPU: of its hidden values, its inputs and its weights.

Matrices and table as in ``network_panels.py``, the network as in ``network_cpu.py``.
"""

from __future__ import annotations

import warp as wp

from .network_panels import PRELUDE

wp.set_module_options({"enable_backward": False})

_ADJOINT = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + PRELUDE
    + """
    // v_values[l]: gradient before the ReLU of layer l, in panels, of the rows from ``first`` on.
    const int layers = table.shape.dims[0], rows = hidden.shape.dims[1], own_rows = v_values.shape.dims[1];
    const int count = v_out.shape.dims[0] - first, most = rows - first < own_rows ? rows - first : own_rows;
    const int begin = block * size, end = begin + size < most ? begin + size : most;
    const long long width = hidden.shape.dims[2], plane = rows * width, own_plane = own_rows * width;
    const int outputs = v_out.shape.dims[1];
    for (int p = 0; p < panels(outputs); ++p)
        for (int i = begin; i < end; ++i)
            for (int j = 0; j < PANEL; ++j) {
                const int column = p * PANEL + j;
                v_values.data[own_plane * (layers - 1) + ((long long)p * own_rows + i) * PANEL + j] =
                    i < count && column < outputs ? v_out.data[(long long)(first + i) * outputs + column] : 0.0f;
            }
    for (int l = layers - 1; l > 0; --l) {
        const long long* own = table.data + (long long)l * COLUMNS;
        const int reads = (int)own[OUTPUTS];
        const float* from = v_values.data + own_plane * l;
        for (int p = 0; p < panels(own[HIDDEN]); ++p)
            for (int c = 0; c < PANEL; c += STRIP) {
                const float* right = packed.data + own[PACKED_ADJOINT] + (long long)p * reads * PANEL + c;
                for (int i = begin; i < end; i += ROWS) {
                    vn acc[ROWS][VECTORS];
                    for (int r = 0; r < ROWS; ++r) for (int v = 0; v < VECTORS; ++v) acc[r][v] = (vn){};
                    for (int k = 0; k < reads; k += PANEL) {
                        const int n = reads - k < PANEL ? reads - k : PANEL;
                        const float* left = from + (long long)k * own_rows + (long long)i * PANEL;
                        accumulate(acc, left, Panel(), One(), right + (long long)k * PANEL, n);
                    }
                    const float* value = hidden.data + plane * (l - 1) + ((long long)p * rows + first + i) * PANEL + c;
                    float* to = v_values.data + own_plane * (l - 1) + ((long long)p * own_rows + i) * PANEL + c;
                    for (int r = 0; r < ROWS; ++r)
                        for (int v = 0; v < VECTORS; ++v) {
                            const vn h = *(const vnu*)(value + r * PANEL + v * LANES);
                            *(vnu*)(to + r * PANEL + v * LANES) = h <= 0.0f ? (vn){} : acc[r][v];
                        }
                }
            }
    }
}
#endif
"""
)

_INPUTS = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + PRELUDE
    + """
    // Gradient of the inputs: over all layers that read them, first to last.
    const int layers = table.shape.dims[0], rows = v_values.shape.dims[1], columns = v_inputs.shape.dims[1];
    const int count = v_inputs.shape.dims[0] - first;
    const int begin = block * size, end = begin + size < rows ? begin + size : rows;
    const long long plane = (long long)rows * v_values.shape.dims[2];
    for (int p = 0; p < panels(columns); ++p)
        for (int c = 0; c < PANEL; c += STRIP)
            for (int i = begin; i < end; i += ROWS) {
                vn acc[ROWS][VECTORS];
                for (int r = 0; r < ROWS; ++r) for (int v = 0; v < VECTORS; ++v) acc[r][v] = (vn){};
                for (int l = 0; l < layers; ++l) {
                    const long long* own = table.data + (long long)l * COLUMNS;
                    if (own[PACKED_INPUTS] < 0) continue;
                    const int reads = (int)own[OUTPUTS];
                    const float* right = packed.data + own[PACKED_INPUTS] + (long long)p * reads * PANEL + c;
                    for (int k = 0; k < reads; k += PANEL) {
                        const int n = reads - k < PANEL ? reads - k : PANEL;
                        const float* left = v_values.data + plane * l + (long long)k * rows + (long long)i * PANEL;
                        accumulate(acc, left, Panel(), One(), right + (long long)k * PANEL, n);
                    }
                }
                for (int r = 0; r < ROWS && i + r < count; ++r)
                    for (int v = 0; v < VECTORS; ++v) {
                        const int column = p * PANEL + c + v * LANES;
                        float* to = v_inputs.data + (long long)(first + i + r) * columns + column;
                        if (column + LANES <= columns) *(vnu*)to = acc[r][v];
                        else for (int j = 0; column + j < columns; ++j) to[j] = acc[r][v][j];
                    }
            }
}
#endif
"""
)

_WEIGHTS = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + PRELUDE
    + """
    // One panel of a layer's outputs: gradients of those rows of its weights [out, in], and of its bias behind them.
    // The sums over the rows of ``v_values`` go on where those over the rows before ``first`` ended.
    const long long* own = table.data + (long long)layer * COLUMNS;
    const int outputs = (int)own[OUTPUTS], rows = hidden.shape.dims[1], own_rows = v_values.shape.dims[1];
    if (panel >= panels(outputs)) return;
    const long long width = hidden.shape.dims[2], plane = rows * width, own_plane = own_rows * width;
    const int from_inputs = (int)own[INPUTS], in = from_inputs + (int)own[HIDDEN];
    float* gradient = (float*)own[GRADIENT];
    const float* v = v_values.data + own_plane * layer + (long long)panel * own_rows * PANEL;
    const int n_out = outputs - panel * PANEL < PANEL ? outputs - panel * PANEL : PANEL;
    if (part == 0) {
        float sums[PANEL] = {};
        float* to = gradient + (long long)outputs * in + panel * PANEL;
        if (first) for (int j = 0; j < n_out; ++j) sums[j] = to[j];
        for (int i = 0; i < count; ++i) for (int j = 0; j < PANEL; ++j) sums[j] += v[i * PANEL + j];
        for (int j = 0; j < n_out; ++j) to[j] = sums[j];
    }
    const int before = panels(from_inputs), all = before + panels(own[HIDDEN]);
    for (int q = part; q < all; q += parts) {
        const bool of_inputs = q < before;
        const float* x = of_inputs ? inputs.data + ((long long)q * rows + first) * PANEL
            : hidden.data + plane * (layer - 1) + ((long long)(q - before) * rows + first) * PANEL;
        const int column = of_inputs ? q * PANEL : from_inputs + (q - before) * PANEL;
        const int n = of_inputs && from_inputs - column < PANEL ? from_inputs - column : PANEL;
        for (int j = 0; j < n_out; j += ROWS)
            for (int c = 0; c < n; c += STRIP) {
                vn acc[ROWS][VECTORS];
                for (int r = 0; r < ROWS; ++r) for (int u = 0; u < VECTORS; ++u) acc[r][u] = (vn){};
                float* to = gradient + (long long)(panel * PANEL + j) * in + column + c;
                // The part of the tile that there is, a vector where it can be one.
                auto visit = [&](auto whole, auto single) {
                    for (int r = 0; r < ROWS && j + r < n_out; ++r)
                        for (int u = 0; u < VECTORS; ++u) {
                            float* at = to + (long long)r * in + u * LANES;
                            if (c + (u + 1) * LANES <= n) whole(at, acc[r][u]);
                            else for (int s = 0; s < LANES && c + u * LANES + s < n; ++s) single(at + s, acc[r][u], s);
                        }
                };
                if (first)
                    visit([](const float* at, vn& sum) { sum = *(const vnu*)at; },
                          [](const float* at, vn& sum, int s) { sum[s] = *at; });
                accumulate(acc, v + j, One(), Panel(), x + c, count);
                visit([](float* at, vn sum) { *(vnu*)at = sum; }, [](float* at, vn sum, int s) { *at = sum[s]; });
            }
    }
}
#endif
"""
)


# fmt: off
@wp.func_native(_ADJOINT)
def _adjoint(
    block: int, size: int, first: int, table: wp.array2d[wp.int64], packed: wp.array[float], hidden: wp.array3d[float],
    v_out: wp.array2d[float], v_values: wp.array3d[float],
): ...


@wp.func_native(_INPUTS)
def _inputs(
    block: int, size: int, first: int, table: wp.array2d[wp.int64], packed: wp.array[float],
    v_values: wp.array3d[float], v_inputs: wp.array2d[float],
): ...


@wp.func_native(_WEIGHTS)
def _weights(
    layer: int, panel: int, part: int, parts: int, first: int, count: int, table: wp.array2d[wp.int64],
    inputs: wp.array3d[float], hidden: wp.array3d[float], v_values: wp.array3d[float],
): ...
# fmt: on


@wp.kernel
def network_adjoint(
    first: int,
    # In:
    size: int,  # rows a block
    begin: int,  # the first of the V rows
    table_in: wp.array2d[wp.int64],  # [L, 9]
    packed_in: wp.array[float],
    hidden_in: wp.array3d[float],  # [L, R, width]
    v_values_in: wp.array2d[float],  # [n, out]
    # Out:
    v_hidden_out: wp.array3d[float],  # [L, V, width] gradient before each layer's ReLU, in panels
):
    _adjoint(first + wp.tid(), size, begin, table_in, packed_in, hidden_in, v_values_in, v_hidden_out)


@wp.kernel
def network_inputs_adjoint(
    first: int,
    # In:
    size: int,  # rows a block
    begin: int,  # the first of the V rows
    table_in: wp.array2d[wp.int64],  # [L, 9]
    packed_in: wp.array[float],
    v_hidden_in: wp.array3d[float],  # [L, V, width]
    # Out:
    v_inputs_out: wp.array2d[float],  # [n, A] of the first columns of the inputs
):
    _inputs(first + wp.tid(), size, begin, table_in, packed_in, v_hidden_in, v_inputs_out)


@wp.kernel
def network_weights_adjoint(
    first: int,
    # In:
    panels: int,  # of the widest layer's outputs
    parts: int,  # tasks that share a panel of outputs
    begin: int,  # the first of the V rows
    count: int,  # how many of them count
    table_in: wp.array2d[wp.int64],  # [L, 9]
    inputs_in: wp.array3d[float],  # [panels, R, 32]
    hidden_in: wp.array3d[float],  # [L, R, width]
    v_hidden_in: wp.array3d[float],  # [L, V, width]
):
    """Writes where the table says, from the second V rows on adds there: gradients of weights and biases."""
    task = first + wp.tid()
    layer = task // (panels * parts)
    rest = task - layer * panels * parts
    _weights(layer, rest // parts, rest % parts, parts, begin, count, table_in, inputs_in, hidden_in, v_hidden_in)
