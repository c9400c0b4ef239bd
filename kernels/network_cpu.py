"""A small multilayer perceptron on a CPU: every layer for a block of rows in one go, forward and adjoint.

Matrices lie in panels of 32 columns: element (i, j) of a matrix with R rows is at ``((j / 32) R + i) 32 + j % 32``.
All three products (values, adjoint of values, adjoint of weights) then stream through memory in one direction, and all
are the same loop: a tile of rows x columns of the result stays in registers while one column of the left factor at a
time meets one row of the right factor. Each sum is taken in the order of its index, by one thread: the bits depend
neither on the number of threads nor on how the rows are cut into blocks.

The network: layer l reads the ``inputs`` (where ``TABLE_INPUTS`` > 0 of its columns are theirs), then the output of
layer l - 1. All layers but the last are followed by a ReLU. A table holds, per layer, what ``TABLE_*`` name.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

PANEL = 32
"""Columns of a panel. Widths of hidden layers are multiples of it."""

BLOCK = 32
"""Rows that one grid index takes through all layers; matrices have a multiple of 8 rows."""

TABLE_COLUMNS = 8
"""Columns of the table of layers, as the enumeration in ``_PRELUDE``: address of the weights [out, in] and of the bias
[out], columns read from the inputs and from the layer before, columns written, where the layer's packed weights begin
(for values, for the adjoint), address of the gradient of the weights (that of the bias lies behind it)."""

_PRELUDE = """
    #pragma clang fp contract(on)
    enum { WEIGHTS, BIAS, INPUTS, HIDDEN, OUTPUTS, PACKED, PACKED_ADJOINT, GRADIENT, COLUMNS };
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
    auto accumulate = [](vn (&sums)[ROWS][VECTORS], const float* left, auto row, auto step, const float* right, int n) {
        vn acc[ROWS][VECTORS];
        #pragma clang loop unroll(full)
        for (int r = 0; r < ROWS; ++r)
            #pragma clang loop unroll(full)
            for (int v = 0; v < VECTORS; ++v) acc[r][v] = sums[r][v];
        for (const float* end = right + n * PANEL; right < end; right += PANEL, left += step.value) {
            vn b[VECTORS];
            #pragma clang loop unroll(full)
            for (int v = 0; v < VECTORS; ++v) b[v] = *(const vnu*)(right + v * LANES);
            #pragma clang loop unroll(full)
            for (int r = 0; r < ROWS; ++r) {
                const float a = left[r * row.value];
                #pragma clang loop unroll(full)
                for (int v = 0; v < VECTORS; ++v) acc[r][v] += a * b[v];
            }
        }
        #pragma clang loop unroll(full)
        for (int r = 0; r < ROWS; ++r)
            #pragma clang loop unroll(full)
            for (int v = 0; v < VECTORS; ++v) sums[r][v] = acc[r][v];
    };
    struct One { enum { value = 1 }; };
    struct Panel { enum { value = PANEL }; };
    auto panels = [](long long columns) -> int { return (int)((columns + PANEL - 1) / PANEL); };
"""

_PACK = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + _PRELUDE
    + """
    const long long* own = table.data + (long long)layer * COLUMNS;
    const float* weights = (const float*)own[WEIGHTS];
    const int in = (int)(own[INPUTS] + own[HIDDEN]), out = (int)own[OUTPUTS];
    if (panel < panels(out)) {  // row k, column j of a panel: weights[j, k]
        float* to = packed.data + own[PACKED] + (long long)panel * in * PANEL;
        const int n = out - panel * PANEL < PANEL ? out - panel * PANEL : PANEL;
        const float* from = weights + (long long)panel * PANEL * in;
        for (int k = 0; k < in; ++k)
            for (int j = 0; j < PANEL; ++j) to[k * PANEL + j] = j < n ? from[(long long)j * in + k] : 0.0f;
    }
    if (own[PACKED_ADJOINT] >= 0 && panel < panels(own[HIDDEN])) {  // row j, column k: weights[j, inputs + k]
        float* to = packed.data + own[PACKED_ADJOINT] + (long long)panel * out * PANEL;
        const float* from = weights + own[INPUTS] + (long long)panel * PANEL;
        for (int j = 0; j < out; ++j) __builtin_memcpy(to + j * PANEL, from + (long long)j * in, PANEL * sizeof(float));
    }
}
#endif
"""
)

_VALUES = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + _PRELUDE
    + """
    const int layers = table.shape.dims[0], rows = hidden.shape.dims[1];
    const int begin = block * size, end = begin + size < rows ? begin + size : rows, count = out.shape.dims[0];
    const int width = hidden.shape.dims[2];
    const long long plane = (long long)rows * width;
    for (int l = 0; l < layers; ++l) {
        const long long* own = table.data + (long long)l * COLUMNS;
        const float* bias = (const float*)own[BIAS];
        const int from_inputs = (int)own[INPUTS], from_hidden = (int)own[HIDDEN], outputs = (int)own[OUTPUTS];
        const float* before = hidden.data + plane * (keep ? l - 1 : (l - 1) & 1);
        float* after = hidden.data + plane * (keep ? l : l & 1);
        for (int p = 0; p < panels(outputs); ++p)
            for (int c = 0; c < PANEL; c += STRIP) {
                if (p * PANEL + c >= outputs) break;
                const float* right = packed.data + own[PACKED] + (long long)p * (from_inputs + from_hidden) * PANEL + c;
                vn start[VECTORS];
                for (int v = 0; v < VECTORS; ++v)
                    for (int j = 0; j < LANES; ++j) {
                        const int column = p * PANEL + c + v * LANES + j;
                        start[v][j] = column < outputs ? bias[column] : 0.0f;
                    }
                for (int i = begin; i < end; i += ROWS) {
                    vn acc[ROWS][VECTORS];
                    for (int r = 0; r < ROWS; ++r) for (int v = 0; v < VECTORS; ++v) acc[r][v] = start[v];
                    const float* b = right;
                    for (int k = 0; k < from_inputs; k += PANEL) {
                        const int n = from_inputs - k < PANEL ? from_inputs - k : PANEL;
                        accumulate(acc, inputs.data + (long long)k * rows + (long long)i * PANEL, Panel(), One(), b, n);
                        b += n * PANEL;
                    }
                    for (int k = 0; k < from_hidden; k += PANEL) {
                        accumulate(acc, before + (long long)k * rows + (long long)i * PANEL, Panel(), One(), b, PANEL);
                        b += PANEL * PANEL;
                    }
                    if (l + 1 < layers) {
                        float* to = after + (long long)p * PANEL * rows + (long long)i * PANEL + c;
                        for (int r = 0; r < ROWS; ++r)
                            for (int v = 0; v < VECTORS; ++v)  // NaN stays
                                *(vnu*)(to + r * PANEL + v * LANES) = acc[r][v] < 0.0f ? (vn){} : acc[r][v];
                        continue;
                    }
                    for (int r = 0; r < ROWS && i + r < count; ++r)
                        for (int v = 0; v < VECTORS; ++v)
                            for (int j = 0; j < LANES; ++j) {
                                const int column = p * PANEL + c + v * LANES + j;
                                if (column < outputs) out.data[(long long)(i + r) * outputs + column] = acc[r][v][j];
                            }
                }
            }
    }
}
#endif
"""
)

_ADJOINT = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + _PRELUDE
    + """
    // v_values[l]: gradient before the ReLU of layer l, in panels.
    const int layers = table.shape.dims[0], rows = hidden.shape.dims[1], count = v_out.shape.dims[0];
    const int begin = block * size, end = begin + size < rows ? begin + size : rows;
    const int width = hidden.shape.dims[2];
    const long long plane = (long long)rows * width;
    const int outputs = v_out.shape.dims[1];
    for (int p = 0; p < panels(outputs); ++p)
        for (int i = begin; i < end; ++i)
            for (int j = 0; j < PANEL; ++j) {
                const int column = p * PANEL + j;
                v_values.data[plane * (layers - 1) + ((long long)p * rows + i) * PANEL + j] =
                    i < count && column < outputs ? v_out.data[(long long)i * outputs + column] : 0.0f;
            }
    for (int l = layers - 1; l > 0; --l) {
        const long long* own = table.data + (long long)l * COLUMNS;
        const int reads = (int)own[OUTPUTS];
        const float* from = v_values.data + plane * l;
        const float* value = hidden.data + plane * (l - 1);
        float* to = v_values.data + plane * (l - 1);
        for (int p = 0; p < panels(own[HIDDEN]); ++p)
            for (int c = 0; c < PANEL; c += STRIP) {
                const float* right = packed.data + own[PACKED_ADJOINT] + (long long)p * reads * PANEL + c;
                for (int i = begin; i < end; i += ROWS) {
                    vn acc[ROWS][VECTORS];
                    for (int r = 0; r < ROWS; ++r) for (int v = 0; v < VECTORS; ++v) acc[r][v] = (vn){};
                    for (int k = 0; k < reads; k += PANEL) {
                        const int n = reads - k < PANEL ? reads - k : PANEL;
                        const float* left = from + (long long)k * rows + (long long)i * PANEL;
                        accumulate(acc, left, Panel(), One(), right + (long long)k * PANEL, n);
                    }
                    const long long at = (long long)p * PANEL * rows + (long long)i * PANEL + c;
                    for (int r = 0; r < ROWS; ++r)
                        for (int v = 0; v < VECTORS; ++v) {
                            const vn h = *(const vnu*)(value + at + r * PANEL + v * LANES);
                            *(vnu*)(to + at + r * PANEL + v * LANES) = h <= 0.0f ? (vn){} : acc[r][v];
                        }
                }
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
    + _PRELUDE
    + """
    // One panel of a layer's outputs: gradients of those rows of its weights [out, in], and of its bias behind them.
    const long long* own = table.data + (long long)layer * COLUMNS;
    const int outputs = (int)own[OUTPUTS], rows = hidden.shape.dims[1], width = hidden.shape.dims[2];
    if (panel >= panels(outputs)) return;
    const long long plane = (long long)rows * width;
    const int from_inputs = (int)own[INPUTS], in = from_inputs + (int)own[HIDDEN];
    float* gradient = (float*)own[GRADIENT];
    const float* v = v_values.data + plane * layer + (long long)panel * rows * PANEL;
    const int n_out = outputs - panel * PANEL < PANEL ? outputs - panel * PANEL : PANEL;
    if (part == 0) {
        float sums[PANEL] = {};
        for (int i = 0; i < count; ++i) for (int j = 0; j < PANEL; ++j) sums[j] += v[i * PANEL + j];
        for (int j = 0; j < n_out; ++j) gradient[(long long)outputs * in + panel * PANEL + j] = sums[j];
    }
    const int before = panels(from_inputs), all = before + panels(own[HIDDEN]);
    for (int q = part; q < all; q += parts) {
        const bool of_inputs = q < before;
        const float* x = of_inputs ? inputs.data + (long long)q * rows * PANEL
                                   : hidden.data + plane * (layer - 1) + (long long)(q - before) * rows * PANEL;
        const int column = of_inputs ? q * PANEL : from_inputs + (q - before) * PANEL;
        const int n = of_inputs && from_inputs - column < PANEL ? from_inputs - column : PANEL;
        for (int j = 0; j < n_out; j += ROWS)
            for (int c = 0; c < n; c += STRIP) {
                vn acc[ROWS][VECTORS];
                for (int r = 0; r < ROWS; ++r) for (int u = 0; u < VECTORS; ++u) acc[r][u] = (vn){};
                accumulate(acc, v + j, One(), Panel(), x + c, count);
                for (int r = 0; r < ROWS && j + r < n_out; ++r) {
                    float* to = gradient + (long long)(panel * PANEL + j + r) * in + column + c;
                    for (int u = 0; u < VECTORS; ++u) {
                        if (c + (u + 1) * LANES <= n) *(vnu*)(to + u * LANES) = acc[r][u];
                        else for (int s = 0; s < LANES && c + u * LANES + s < n; ++s) to[u * LANES + s] = acc[r][u][s];
                    }
                }
            }
    }
}
#endif
"""
)


# fmt: off
@wp.func_native(_PACK)
def _pack(layer: int, panel: int, table: wp.array2d[wp.int64], packed: wp.array[float]): ...


@wp.func_native(_VALUES)
def _values(
    block: int, size: int, keep: int, table: wp.array2d[wp.int64], packed: wp.array[float], inputs: wp.array3d[float],
    hidden: wp.array3d[float], out: wp.array2d[float],
): ...


@wp.func_native(_ADJOINT)
def _adjoint(
    block: int, size: int, table: wp.array2d[wp.int64], packed: wp.array[float], hidden: wp.array3d[float],
    v_out: wp.array2d[float], v_values: wp.array3d[float],
): ...


@wp.func_native(_WEIGHTS)
def _weights(
    layer: int, panel: int, part: int, parts: int, count: int, table: wp.array2d[wp.int64], inputs: wp.array3d[float],
    hidden: wp.array3d[float], v_values: wp.array3d[float],
): ...
# fmt: on


@wp.kernel
def pack_weights(
    first: int,
    # In:
    panels: int,  # of the widest matrix
    table_in: wp.array2d[wp.int64],  # [L, 8]
    # Out:
    packed_out: wp.array[float],
):
    """Weights in panels, as both products of a layer want them."""
    task = first + wp.tid()
    _pack(task // panels, task % panels, table_in, packed_out)


@wp.kernel
def pack_inputs(
    first: int,
    # In:
    where_in: wp.array2d[float],  # [M, A] what depends on the position
    when_in: wp.array2d[float],  # [T, B] what depends on the time
    # Out:
    inputs_out: wp.array3d[float],  # [panels, R, 32], R >= T M; rows t M + m; zero where there is nothing
):
    """Every position at every time, side by side."""
    i = first + wp.tid()
    positions = where_in.shape[0]
    wide = where_in.shape[1]
    all = wide + when_in.shape[1]
    t = i // positions
    for c in range(inputs_out.shape[0] * PANEL):
        value = float(0.0)
        if t < when_in.shape[0] and c < all:
            if c < wide:
                value = where_in[i - t * positions, c]
            else:
                value = when_in[t, c - wide]
        inputs_out[c // PANEL, i, c % PANEL] = value


@wp.kernel
def network_values(
    first: int,
    # In:
    size: int,  # rows a block
    keep: int,  # 1: hidden has room for every layer, for the adjoint; 0: for two
    table_in: wp.array2d[wp.int64],  # [L, 8]
    packed_in: wp.array[float],
    inputs_in: wp.array3d[float],  # [panels, R, 32]
    # Out:
    hidden_out: wp.array3d[float],  # [L or 2, R, width], each in panels
    values_out: wp.array2d[float],  # [n, out], n <= R
):
    _values(first + wp.tid(), size, keep, table_in, packed_in, inputs_in, hidden_out, values_out)


@wp.kernel
def network_adjoint(
    first: int,
    # In:
    size: int,  # rows a block
    table_in: wp.array2d[wp.int64],  # [L, 8]
    packed_in: wp.array[float],
    hidden_in: wp.array3d[float],  # [L, R, width]
    v_values_in: wp.array2d[float],  # [n, out]
    # Out:
    v_hidden_out: wp.array3d[float],  # [L, R, width] gradient before each layer's ReLU, in panels
):
    _adjoint(first + wp.tid(), size, table_in, packed_in, hidden_in, v_values_in, v_hidden_out)


@wp.kernel
def network_weights_adjoint(
    first: int,
    # In:
    panels: int,  # of the widest layer's outputs
    parts: int,  # tasks that share a panel of outputs
    count: int,  # rows that count
    table_in: wp.array2d[wp.int64],  # [L, 8]
    inputs_in: wp.array3d[float],  # [panels, R, 32]
    hidden_in: wp.array3d[float],  # [L, R, width]
    v_hidden_in: wp.array3d[float],  # [L, R, width]
):
    """Writes where the table says: gradients of weights and biases."""
    task = first + wp.tid()
    layer = task // (panels * parts)
    rest = task - layer * panels * parts
    _weights(layer, rest // parts, rest % parts, parts, count, table_in, inputs_in, hidden_in, v_hidden_in)
