"""Outcome of a recorded training step, decided on the device: the host reads it one step later.

A step that is not committed changes no parameter; unless only a gradient is non-finite, it changes no statistics
either. Its outcome is a number: ``STEP_FINE``, or the least of the numbers of everything that failed. There is one
form, for any device.
"""

from __future__ import annotations

import warp as wp

from .types import ADAM_CHUNK, STEP_FINE, STEP_GRADIENT, STEP_HALTED, STEP_LOSS, STEP_REGULARISER

wp.set_module_options({"enable_backward": False})

_CHUNK = wp.constant(ADAM_CHUNK)


@wp.kernel
def judge_loss(
    first: int,
    # In:
    pairs_in: wp.array[wp.int64],  # [1] pairs of splat and tile
    room: wp.int64,  # for pairs
    loss_in: wp.array[float],  # [1]
    regulariser_in: wp.array[float],  # [1]
    has_regulariser: int,
    # Out:
    halted_out: wp.array[int],  # [1] set to 1 by a step with too little room
    outcome_out: wp.array[int],  # [1]
):
    """Decide whether the lists were complete and the loss is finite. Grid: 1."""
    outcome = int(STEP_FINE)
    if has_regulariser != 0:
        if not wp.isfinite(regulariser_in[0]):
            outcome = STEP_REGULARISER
    if not wp.isfinite(loss_in[0]):
        outcome = STEP_LOSS
    if pairs_in[0] > room:
        halted_out[0] = 1
    if halted_out[0] != 0:
        outcome = STEP_HALTED
    outcome_out[first + wp.tid()] = outcome


@wp.kernel
def judge_gradients(
    first: int,
    # In:
    addresses_in: wp.array[wp.int64],  # [T] of the gradients
    sizes_in: wp.array[wp.int64],  # [T] elements
    chunks_in: wp.array2d[wp.int64],  # [C, 2] tensor, first element
    # Out (lowered):
    outcome_out: wp.array[int],  # [1]
):
    """Search the gradients for an infinity or a NaN. Grid: C x ADAM_CHUNK."""
    i = first + wp.tid()
    chunk = i // _CHUNK
    tensor = int(chunks_in[chunk, 0])
    at = int(chunks_in[chunk, 1]) + i - chunk * _CHUNK
    size = int(sizes_in[tensor])
    if at >= size:
        return
    values = wp.array(ptr=wp.uint64(addresses_in[tensor]), shape=(size,), dtype=float)
    if not wp.isfinite(values[at]):
        wp.atomic_min(outcome_out, 0, STEP_GRADIENT + tensor)


@wp.kernel
def adam_factors(
    first: int,
    # In:
    rates_in: wp.array[wp.float64],  # [G] learning rate of each parameter
    rows_in: wp.array[int],  # [T] parameter of each tensor
    outcome_in: wp.array[int],  # [1]
    beta1: wp.float64,
    beta2: wp.float64,
    # Out:
    counts_out: wp.array[int],  # [G] steps taken by each parameter, raised by one
    factors_out: wp.array2d[float],  # [T, 2] rate / (1 - beta1^t), 1 / sqrt(1 - beta2^t)
):
    """Count the step of each tensor if it is taken, and correct the tensor's rate for the bias. Grid: T."""
    t = first + wp.tid()
    row = rows_in[t]
    count = counts_out[row] + 1
    if outcome_in[0] == STEP_FINE:
        counts_out[row] = count
    one = wp.float64(1.0)
    first_power = wp.pow(beta1, wp.float64(count))
    second_power = wp.pow(beta2, wp.float64(count))
    factors_out[t, 0] = float(rates_in[row] / (one - first_power))
    factors_out[t, 1] = float(wp.pow(one - second_power, wp.float64(-0.5)))


@wp.kernel
def report(
    first: int,
    # In:
    outcome_in: wp.array[int],  # [1]
    pairs_in: wp.array[wp.int64],  # [1]
    loss_in: wp.array[float],  # [1]
    l1_in: wp.array[float],  # [1]
    ssim_in: wp.array[float],  # [1]
    regulariser_in: wp.array[float],  # [1]
    has_regulariser: int,
    shown_in: wp.array[float],  # [1] largest alpha
    # Out:
    report_out: wp.array[wp.float64],  # [7] in the order of the arguments
):
    """Collect what the host reads. Grid: 1."""
    i = first + wp.tid()
    report_out[0] = wp.float64(outcome_in[i])
    report_out[1] = wp.float64(pairs_in[i])
    report_out[2] = wp.float64(loss_in[i])
    report_out[3] = wp.float64(l1_in[i])
    report_out[4] = wp.float64(ssim_in[i])
    report_out[5] = wp.float64(0.0)
    if has_regulariser != 0:
        report_out[5] = wp.float64(regulariser_in[i])
    report_out[6] = wp.float64(shown_in[i])
