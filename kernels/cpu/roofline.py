"""Loops that reach a CPU's limits, for comparison with measured times: multiply-adds in registers, and copies."""

from __future__ import annotations

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False})


# fmt: off
@native_function("roofline.h")
def multiply_add_chains(index: int, rounds: int, values: wp.array[float]): ...


@native_function("roofline.h")
def copy_block(index: int, source: wp.array[float], target: wp.array[float]): ...
# fmt: on


@wp.kernel
def multiply_add(
    first: int,
    # In:
    rounds: int,
    # Out:
    values_out: wp.array[float],  # [C] written, so that no compiler drops the loop
):
    """Run ROOFLINE_CHAINS independent chains of multiply-adds. Grid: C."""
    multiply_add_chains(first + wp.tid(), rounds, values_out)


@wp.kernel
def copy(
    first: int,
    # In:
    source_in: wp.array[float],  # [B * ROOFLINE_BLOCK] aligned to 64 bytes
    # Out:
    target_out: wp.array[float],  # [B * ROOFLINE_BLOCK] aligned to 64 bytes
):
    """Copy one block of 1 MiB. Grid: B."""
    copy_block(first + wp.tid(), source_in, target_out)
