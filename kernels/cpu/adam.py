"""Adam in SIMD, one chunk per grid index, and the search for non-finite values. The tables are those of ``adam``."""

from __future__ import annotations

import warp as wp

from ..native import native_function

wp.set_module_options({"enable_backward": False})


# fmt: off
@native_function("adam.h")
def adam_chunk(
    chunk: int, addresses: wp.array2d[wp.int64], factors: wp.array2d[float], sizes: wp.array[wp.int64],
    chunks: wp.array2d[wp.int64], one_beta1: float, beta2: float, one_beta2: float, eps: float,
): ...


@native_function("adam.h")
def find_non_finite_in_chunk(
    chunk: int, addresses: wp.array[wp.int64], sizes: wp.array[wp.int64], chunks: wp.array2d[wp.int64],
    found: wp.array[int],
): ...
# fmt: on


@wp.kernel
def adam_step(
    first: int,
    # In:
    addresses_in: wp.array2d[wp.int64],  # [T, 4] of values, gradients, first and second moments
    factors_in: wp.array2d[float],  # [T, 2] rate / (1 - beta1^t), 1 / sqrt(1 - beta2^t)
    sizes_in: wp.array[wp.int64],  # [T] elements
    chunks_in: wp.array2d[wp.int64],  # [C, 2] tensor, first element
    one_beta1: float,  # 1 - beta1
    beta2: float,
    one_beta2: float,  # 1 - beta2
    eps: float,
):
    """Update one chunk and its moments in place. Grid: C."""
    adam_chunk(first + wp.tid(), addresses_in, factors_in, sizes_in, chunks_in, one_beta1, beta2, one_beta2, eps)


@wp.kernel
def find_non_finite(
    first: int,
    # In:
    addresses_in: wp.array[wp.int64],  # [T]
    sizes_in: wp.array[wp.int64],  # [T] elements
    chunks_in: wp.array2d[wp.int64],  # [C, 2] tensor, first element
    # Out:
    found_out: wp.array[int],  # [C] 1 where the chunk holds a non-finite value, else 0
):
    """Mark the chunk if it holds an infinity or a NaN. Grid: C."""
    find_non_finite_in_chunk(first + wp.tid(), addresses_in, sizes_in, chunks_in, found_out)
