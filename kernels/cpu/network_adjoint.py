"""Adjoint of a small multilayer perceptron on a CPU: gradients of its hidden values, inputs and weights.

The network, its matrices and its table are those of ``network``.
"""

from __future__ import annotations

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False})


# fmt: off
@native_function("network_adjoint.h")
def network_block_adjoint(
    block: int, size: int, first: int, table: wp.array2d[wp.int64], packed: wp.array[float], finite: wp.array2d[int],
    hidden: wp.array3d[float], v_out: wp.array2d[float], v_hidden: wp.array3d[float],
): ...


@native_function("network_adjoint.h")
def network_inputs_block_adjoint(
    block: int, size: int, first: int, table: wp.array2d[wp.int64], packed: wp.array[float],
    v_hidden: wp.array3d[float], v_inputs: wp.array2d[float],
): ...


@native_function("network_adjoint.h")
def network_panel_adjoint(
    layer: int, panel: int, part: int, parts: int, first: int, count: int, table: wp.array2d[wp.int64],
    inputs: wp.array3d[float], hidden: wp.array3d[float], v_hidden: wp.array3d[float],
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
    finite_in: wp.array2d[int],  # [L, panels] 1: the weights of this panel of outputs are finite
    hidden_in: wp.array3d[float],  # [L, R, width]
    v_values_in: wp.array2d[float],  # [n, out]
    # Out:
    v_hidden_out: wp.array3d[float],  # [L, V, width] gradient before each layer's ReLU, in panels
):
    """Propagate gradients back through all layers for a block of rows. Grid: blocks."""
    network_block_adjoint(
        first + wp.tid(), size, begin, table_in, packed_in, finite_in, hidden_in, v_values_in, v_hidden_out
    )  # fmt: skip


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
    """Add up the gradients of the inputs over the layers that read them. Grid: blocks."""
    task = first + wp.tid()
    network_inputs_block_adjoint(task, size, begin, table_in, packed_in, v_hidden_in, v_inputs_out)


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
    """Write the gradients of weights and biases to the table's addresses. Grid: L x panels x parts.

    A launch covers V rows from ``begin``; if ``begin`` is not 0, its sums are added to those of earlier launches.
    """
    task = first + wp.tid()
    layer = task // (panels * parts)
    rest = task - layer * panels * parts
    network_panel_adjoint(
        layer, rest // parts, rest % parts, parts, begin, count, table_in, inputs_in, hidden_in, v_hidden_in
    )  # fmt: skip
