"""Adam (Kingma and Ba 2015, algorithm 1) over many tensors in one launch.

A launch reads a table with the addresses of each tensor, one row per tensor, and a list of chunks. Thus 30 tensors cost
one launch, and each value is read once and written once. This form updates one element per grid index, pads the last
chunk of a tensor, and runs on any device; ``cpu/adam.py`` updates one chunk per grid index.
"""

from __future__ import annotations

import warp as wp

from .types import ADAM_CHUNK, ADAM_GRADIENT_MAX, STEP_FINE

wp.set_module_options({"enable_backward": False})

_CHUNK = wp.constant(ADAM_CHUNK)


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
    outcome_in: wp.array[int],  # [1] of a recorded step: nothing is updated unless it is STEP_FINE
    has_outcome: int,
):
    """Update one element and its moments in place. Grid: C x ADAM_CHUNK."""
    if has_outcome != 0:
        if outcome_in[0] != STEP_FINE:
            return
    i = first + wp.tid()
    chunk = i // _CHUNK
    tensor = int(chunks_in[chunk, 0])
    at = int(chunks_in[chunk, 1]) + i - chunk * _CHUNK
    size = int(sizes_in[tensor])
    if at >= size:
        return
    values = wp.array(ptr=wp.uint64(addresses_in[tensor, 0]), shape=(size,), dtype=float)
    gradients = wp.array(ptr=wp.uint64(addresses_in[tensor, 1]), shape=(size,), dtype=float)
    averages = wp.array(ptr=wp.uint64(addresses_in[tensor, 2]), shape=(size,), dtype=float)
    squares = wp.array(ptr=wp.uint64(addresses_in[tensor, 3]), shape=(size,), dtype=float)
    g = gradients[at]
    if wp.isfinite(g):  # NaN is kept, because the caller searches for it
        g = wp.clamp(g, -ADAM_GRADIENT_MAX, ADAM_GRADIENT_MAX)
    m = averages[at] + one_beta1 * (g - averages[at])
    v = beta2 * squares[at] + one_beta2 * (g * g)
    averages[at] = m
    squares[at] = v
    values[at] = values[at] - factors_in[tensor, 0] * m / (wp.sqrt(v) * factors_in[tensor, 1] + eps)
