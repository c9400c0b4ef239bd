"""Exponential and sigmoid functions on a CPU, 16 values at a time. Their portable form is torch."""

import warp as wp

from ..native import native_function
from ..types import LANES

wp.set_module_options({"enable_backward": False})

_LANES = wp.constant(LANES)


# fmt: off
@native_function("activations.h")
def exponential_block(begin: int, values: wp.array[float], results: wp.array[float]): ...


@native_function("activations.h")
def sigmoid_block(begin: int, values: wp.array[float], results: wp.array[float]): ...
# fmt: on


@wp.kernel
def exponential(
    first: int,
    # In:
    values_in: wp.array[float],  # [N]
    # Out:
    results_out: wp.array[float],  # [N]
):
    """Compute exp of 16 values. Grid: ceil(N / 16)."""
    exponential_block((first + wp.tid()) * _LANES, values_in, results_out)


@wp.kernel
def sigmoid(
    first: int,
    # In:
    values_in: wp.array[float],  # [N]
    # Out:
    results_out: wp.array[float],  # [N]
):
    """Compute 1 / (1 + exp(-x)) of 16 values. Grid: ceil(N / 16)."""
    sigmoid_block((first + wp.tid()) * _LANES, values_in, results_out)
