"""A small multilayer perceptron on a CPU: every layer for a block of rows in one go.

Matrices lie in panels, ``network_panels.py`` says how, and why.

The network: layer l reads the ``inputs`` (where any of its columns are theirs), then the output of layer l - 1. All
layers but the last are followed by a ReLU. A table holds, per layer, what ``TABLE_COLUMNS`` names.
"""

from __future__ import annotations

import warp as wp

from .network_panels import PRELUDE

wp.set_module_options({"enable_backward": False})

_PACK = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + PRELUDE
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
    if (own[PACKED_INPUTS] >= 0 && panel < panels(own[INPUTS])) {  // row j, column k: weights[j, k]
        float* to = packed.data + own[PACKED_INPUTS] + (long long)panel * out * PANEL;
        const int n = own[INPUTS] - panel * PANEL < PANEL ? own[INPUTS] - panel * PANEL : PANEL;
        const float* from = weights + (long long)panel * PANEL;
        for (int j = 0; j < out; ++j)
            for (int k = 0; k < PANEL; ++k) to[j * PANEL + k] = k < n ? from[(long long)j * in + k] : 0.0f;
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
    + PRELUDE
    + """
    const int layers = table.shape.dims[0], rows = hidden.shape.dims[1];
    const int begin = block * size, end = begin + size < rows ? begin + size : rows, count = out.shape.dims[0];
    const int width = hidden.shape.dims[2];
    const long long plane = (long long)rows * width;
    struct Full { enum { value = VECTORS }; };
    struct Half { enum { value = 1 }; };
    // A strip of one or two vectors of a layer's outputs, for the rows of the block.
    auto tile = [&](auto vectors, int l, int p, int c) {
        constexpr int V = decltype(vectors)::value;
        const long long* own = table.data + (long long)l * COLUMNS;
        const float* bias = (const float*)own[BIAS];
        const int from_inputs = (int)own[INPUTS], from_hidden = (int)own[HIDDEN], outputs = (int)own[OUTPUTS];
        const float* before = hidden.data + plane * (keep ? l - 1 : (l - 1) & 1);
        float* after = hidden.data + plane * (keep ? l : l & 1);
        const float* right = packed.data + own[PACKED] + (long long)p * (from_inputs + from_hidden) * PANEL + c;
        vn start[V];
        for (int v = 0; v < V; ++v)
            for (int j = 0; j < LANES; ++j) {
                const int column = p * PANEL + c + v * LANES + j;
                start[v][j] = column < outputs ? bias[column] : 0.0f;
            }
        for (int i = begin; i < end; i += ROWS) {
            vn acc[ROWS][V];
            for (int r = 0; r < ROWS; ++r) for (int v = 0; v < V; ++v) acc[r][v] = start[v];
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
                    for (int v = 0; v < V; ++v)  // NaN stays
                        *(vnu*)(to + r * PANEL + v * LANES) = acc[r][v] < 0.0f ? (vn){} : acc[r][v];
                continue;
            }
            for (int r = 0; r < ROWS && i + r < count; ++r)
                for (int v = 0; v < V; ++v)
                    for (int j = 0; j < LANES; ++j) {
                        const int column = p * PANEL + c + v * LANES + j;
                        if (column < outputs) out.data[(long long)(i + r) * outputs + column] = acc[r][v][j];
                    }
        }
    };
    for (int l = 0; l < layers; ++l) {
        const int outputs = (int)table.data[(long long)l * COLUMNS + OUTPUTS];
        for (int p = 0; p < panels(outputs); ++p)
            for (int c = 0; c < PANEL; c += STRIP) {
                if (p * PANEL + c >= outputs) break;
                // Of a last layer as narrow as that, half a tile is enough.
                if (p * PANEL + c + LANES < outputs) tile(Full(), l, p, c); else tile(Half(), l, p, c);
            }
    }
}
#endif
"""
)

_ROW = """
#if !defined(__CUDA_ARCH__)
{
    enum { PANEL = 32 };
    const int positions = where.shape.dims[0], wide = where.shape.dims[1], narrow = when.shape.dims[1];
    const int t = row / positions, rows = inputs.shape.dims[1];
    const bool there = t < when.shape.dims[0];  // not one of the rows that fill up
    const float* a = where.data + (long long)(row - t * positions) * wide;
    const float* b = when.data + (long long)t * narrow;
    for (int p = 0; p < inputs.shape.dims[0]; ++p) {
        float* to = inputs.data + ((long long)p * rows + row) * PANEL;
        if (there && (p + 1) * PANEL <= wide) __builtin_memcpy(to, a + p * PANEL, PANEL * sizeof(float));
        else for (int j = 0; j < PANEL; ++j) {
            const int c = p * PANEL + j;
            to[j] = there && c < wide + narrow ? (c < wide ? a[c] : b[c - wide]) : 0.0f;
        }
    }
}
#endif
"""


# fmt: off
@wp.func_native(_ROW)
def _row(
    row: int, where: wp.array2d[float], when: wp.array2d[float], inputs: wp.array3d[float],
): ...


@wp.func_native(_PACK)
def _pack(layer: int, panel: int, table: wp.array2d[wp.int64], packed: wp.array[float]): ...


@wp.func_native(_VALUES)
def _values(
    block: int, size: int, keep: int, table: wp.array2d[wp.int64], packed: wp.array[float], inputs: wp.array3d[float],
    hidden: wp.array3d[float], out: wp.array2d[float],
): ...


# fmt: on


@wp.kernel
def pack_weights(
    first: int,
    # In:
    panels: int,  # of the widest matrix
    table_in: wp.array2d[wp.int64],  # [L, 9]
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
    _row(first + wp.tid(), where_in, when_in, inputs_out)


@wp.kernel
def network_values(
    first: int,
    # In:
    size: int,  # rows a block
    keep: int,  # 1: hidden has room for every layer, for the adjoint; 0: for two
    table_in: wp.array2d[wp.int64],  # [L, 9]
    packed_in: wp.array[float],
    inputs_in: wp.array3d[float],  # [panels, R, 32]
    # Out:
    hidden_out: wp.array3d[float],  # [L or 2, R, width], each in panels
    values_out: wp.array2d[float],  # [n, out], n <= R
):
    _values(first + wp.tid(), size, keep, table_in, packed_in, inputs_in, hidden_out, values_out)
