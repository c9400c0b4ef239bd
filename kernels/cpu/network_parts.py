"""Evaluation of a small multilayer perceptron on a CPU by the tile registers of AMX, in the precision of float32.

The network, its matrices and its table are those of ``network``. An int32 holds parts of two numbers in bfloat16
(``native/network_parts.h``). On a processor without these registers the kernels do nothing.
"""

from __future__ import annotations

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False})


# fmt: off
@native_function("network_parts.h")
def network_block_parts(
    block: int, size: int, keep: int, table: wp.array2d[wp.int64], inputs: wp.array3d[float],
    input_parts: wp.array2d[int], hidden_parts: wp.array2d[int], weight_parts: wp.array2d[int],
    hidden: wp.array3d[float], out: wp.array2d[float],
): ...
# fmt: on


@wp.kernel
def network_values_parts(
    first: int,
    # In:
    size: int,  # rows a block, a multiple of 32
    keep: int,  # 1: write the hidden values, for the adjoint
    table_in: wp.array2d[wp.int64],  # [L, 9]
    inputs_in: wp.array3d[float],  # [panels, R, 32]
    # Scratch, for the blocks of one launch:
    input_parts_tmp: wp.array2d[int],  # [S, 48 panels size]
    hidden_parts_tmp: wp.array2d[int],  # [S, 3 width size] of two layers
    weight_parts_tmp: wp.array2d[int],  # [S, 1536 P] P panels: the most that a layer reads
    # Out:
    hidden_out: wp.array3d[float],  # [L, R, width], each in panels, touched only with keep
    values_out: wp.array2d[float],  # [n, out], n <= R
):
    """Evaluate all layers for a block of rows. Grid: blocks, at most S in a launch."""
    network_block_parts(
        first + wp.tid(), size, keep, table_in, inputs_in,
        input_parts_tmp, hidden_parts_tmp, weight_parts_tmp, hidden_out, values_out
    )  # fmt: skip
