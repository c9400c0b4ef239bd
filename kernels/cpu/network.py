"""A small multilayer perceptron on a CPU: each block of rows passes through all layers at once.

Matrices are stored in panels of 32 columns (``native/network_panels.h``). Layer l reads the ``inputs`` (if the table
gives it input columns), then the output of layer l - 1. A ReLU follows every layer but the last. The columns of the
table of layers are listed in ``network_panels.h``. On other devices torch runs the network.
"""

from __future__ import annotations

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False})


# fmt: off
@native_function("network.h")
def pack_row(
    row: int, where: wp.array2d[float], when: wp.array2d[float], inputs: wp.array3d[float],
): ...


@native_function("network.h")
def pack_panel(
    layer: int, panel: int, adjoint: int, table: wp.array2d[wp.int64], packed: wp.array[float], finite: wp.array2d[int],
): ...


@native_function("network.h")
def network_block_sums(
    block: int, size: int, known: int, table: wp.array2d[wp.int64], packed: wp.array[float], inputs: wp.array3d[float],
    sums: wp.array3d[float],
): ...


@native_function("network.h")
def network_block(
    block: int, size: int, keep: int, known: int, table: wp.array2d[wp.int64], packed: wp.array[float],
    finite: wp.array2d[int], inputs: wp.array3d[float], sums: wp.array3d[float], order: wp.array[int],
    hidden: wp.array3d[float], out: wp.array2d[float],
): ...


@native_function("network.h")
def pair_products(found: wp.array[int]): ...


# fmt: on


@wp.kernel
def find_pair_products(
    first: int,
    # Out:
    found_out: wp.array[int],  # [1]
):
    """Write how this processor adds products of two bfloat16: 0 one by one, 1 in pairs, 2 in tiles too. Grid: 1."""
    pair_products(found_out)


@wp.kernel
def pack_weights(
    first: int,
    # In:
    panels: int,  # of the widest matrix
    adjoint: int,  # 1: pack for the adjoint of the layer before as well
    table_in: wp.array2d[wp.int64],  # [L, 9]
    # Out:
    packed_out: wp.array[float],
    finite_out: wp.array2d[int],  # [L, panels] 1: the weights of this panel of outputs are finite
):
    """Pack weights into panels, in the layout that each matrix product of a layer reads. Grid: L x panels."""
    task = first + wp.tid()
    pack_panel(task // panels, task % panels, adjoint, table_in, packed_out, finite_out)


@wp.kernel
def pack_inputs(
    first: int,
    # In:
    where_in: wp.array2d[float],  # [M, A] what depends on the position
    when_in: wp.array2d[float],  # [T, B] what depends on the time
    # Out:
    inputs_out: wp.array3d[float],  # [panels, R, 32], R >= T M; rows t M + m; zero elsewhere
):
    """Write the input row of one pair of position and time: the position's columns, then the time's. Grid: R."""
    pack_row(first + wp.tid(), where_in, when_in, inputs_out)


@wp.kernel
def network_sums(
    first: int,
    # In:
    size: int,  # rows a block
    known: int,  # columns to sum
    table_in: wp.array2d[wp.int64],  # [L, 9]
    packed_in: wp.array[float],
    inputs_in: wp.array3d[float],  # [panels, R, 32]
    # Out:
    sums_out: wp.array3d[float],  # [S, R, width], each in panels; S layers read the inputs
):
    """Sum what the first columns of the inputs add to the biases of the layers that read them. Grid: blocks."""
    network_block_sums(first + wp.tid(), size, known, table_in, packed_in, inputs_in, sums_out)


@wp.kernel
def network_values(
    first: int,
    # In:
    size: int,  # rows a block
    keep: int,  # 1: hidden has room for every layer, for the adjoint; 0: for two
    known: int,  # columns of the inputs whose sums are in sums_in, or 0
    table_in: wp.array2d[wp.int64],  # [L, 9]
    packed_in: wp.array[float],
    finite_in: wp.array2d[int],  # [L, panels]
    inputs_in: wp.array3d[float],  # [panels, R, 32]; with known columns one row, which all share: [panels, 1, 32]
    sums_in: wp.array3d[float],  # [S, R, width], touched only with known
    order_in: wp.array[int],  # [n] row of values_out for each row; empty: the same
    # Out:
    hidden_out: wp.array3d[float],  # [L or 2, R, width], each in panels
    values_out: wp.array2d[float],  # [n, out], n <= R
):
    """Evaluate all layers for a block of rows. Grid: blocks."""
    network_block(
        first + wp.tid(), size, keep, known, table_in, packed_in, finite_in, inputs_in, sums_in, order_in,
        hidden_out, values_out
    )  # fmt: skip
