"""Adjoint of a small multilayer perceptron on a CPU whose factors are rounded to bfloat16, with sums in float32.

The network, its matrices and its table are those of ``network``. An int32 holds two bfloat16 numbers, of consecutive
rows or of two columns (``native/network_pairs.h``).
"""

from __future__ import annotations

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False})


# fmt: off
@native_function("network_pairs.h")
def pack_panel_pairs(layer: int, panel: int, table: wp.array2d[wp.int64], packed: wp.array[int]): ...


@native_function("network_pairs.h")
def network_block_adjoint_pairs(
    block: int, size: int, first: int, tiles: int, table: wp.array2d[wp.int64], packed: wp.array[int],
    finite: wp.array2d[int], inputs: wp.array3d[float], hidden: wp.array3d[float], v_out: wp.array2d[float],
    columns: wp.array3d[int], input_rows: wp.array3d[int], hidden_rows: wp.array3d[int], v_rows: wp.array3d[int],
): ...


@native_function("network_pairs.h")
def network_panel_adjoint_pairs(
    layer: int, panel: int, part: int, parts: int, first: int, count: int, tiles: int, table: wp.array2d[wp.int64],
    input_rows: wp.array3d[int], hidden_rows: wp.array3d[int], v_rows: wp.array3d[int],
): ...
# fmt: on


@wp.kernel
def pack_weight_pairs(
    first: int,
    # In:
    panels: int,  # of the widest matrix
    table_in: wp.array2d[wp.int64],  # [L, 9]
    # Out:
    packed_out: wp.array[int],
):
    """Pack weights for the adjoint of the layer before, in pairs of outputs. Grid: L x panels."""
    task = first + wp.tid()
    pack_panel_pairs(task // panels, task % panels, table_in, packed_out)


@wp.kernel
def network_adjoint_pairs(
    first: int,
    # In:
    size: int,  # rows a block
    begin: int,  # the first of the V rows
    tiles: int,  # whether to use AMX
    table_in: wp.array2d[wp.int64],  # [L, 9]
    packed_in: wp.array[int],
    finite_in: wp.array2d[int],  # [L, panels] 1: the weights of this panel of outputs are finite; ignored with tiles
    inputs_in: wp.array3d[float],  # [panels, R, 32]
    hidden_in: wp.array3d[float],  # [L, R, width]
    v_values_in: wp.array2d[float],  # [n, out]
    # Scratch:
    columns_tmp: wp.array3d[int],  # [2, V, width / 2] gradients of two layers, paired by columns
    # Out:
    input_rows_out: wp.array3d[int],  # [panels, V / 2, 32] inputs, paired by rows, in panels
    hidden_rows_out: wp.array3d[int],  # [L - 1, V / 2, width] likewise
    v_rows_out: wp.array3d[int],  # [L, V / 2, width] gradient before each layer's ReLU, likewise
):
    """Propagate gradients back through all layers for a block of rows, and pair the rows. Grid: blocks."""
    network_block_adjoint_pairs(
        first + wp.tid(), size, begin, tiles, table_in, packed_in, finite_in, inputs_in, hidden_in, v_values_in,
        columns_tmp, input_rows_out, hidden_rows_out, v_rows_out
    )  # fmt: skip


@wp.kernel
def network_weights_adjoint_pairs(
    first: int,
    # In:
    panels: int,  # of the widest layer's outputs
    parts: int,  # tasks that share a panel of outputs
    begin: int,  # the first of the V rows
    count: int,  # how many of them count
    tiles: int,  # whether to use AMX
    table_in: wp.array2d[wp.int64],  # [L, 9]
    input_rows_in: wp.array3d[int],  # [panels, V / 2, 32]
    hidden_rows_in: wp.array3d[int],  # [L - 1, V / 2, width]
    v_rows_in: wp.array3d[int],  # [L, V / 2, width]
):
    """Write the gradients of weights and biases to the table's addresses. Grid: L x panels x parts.

    A launch covers V rows from ``begin``; if ``begin`` is not 0, its sums are added to those of earlier launches.
    """
    task = first + wp.tid()
    layer = task // (panels * parts)
    rest = task - layer * panels * parts
    network_panel_adjoint_pairs(
        layer, rest // parts, rest % parts, parts, begin, count, tiles,
        table_in, input_rows_in, hidden_rows_in, v_rows_in
    )  # fmt: skip
