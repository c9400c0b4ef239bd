"""Exponential and sigmoid functions, with gradients: the same bits on any number of threads."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from ..kernels.cpu import activations as cpu_kernels
from ..kernels.types import LANES
from ..runtime.launch import launch

GRAIN = 256
"""Least number of vectors of ``LANES`` values in a chunk, which take some microseconds."""


def _map(kernel: wp.Kernel, values: Tensor) -> Tensor:
    """Apply a kernel to all values."""
    result = torch.empty_like(values)
    launch(kernel, -(-values.numel() // LANES), values.view(-1), result.view(-1), grain=GRAIN)
    return result


class _Exponential(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        result = _map(cpu_kernels.exponential, values)
        ctx.save_for_backward(result)
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_result: Tensor):  # type: ignore[override]
        (result,) = ctx.saved_tensors
        return v_result * result


class _Sigmoid(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        result = _map(cpu_kernels.sigmoid, values)
        ctx.save_for_backward(result)
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_result: Tensor):  # type: ignore[override]
        (result,) = ctx.saved_tensors
        return v_result * ((1.0 - result) * result)


def exponential(values: Tensor) -> Tensor:
    """Return exp of float32 values of any shape, to 2e-7 of the result; infinity above 88.72, 0 below -103.98.

    Torch's own results on a CPU change with the number of threads. On CUDA this is ``values.exp()``.
    """
    return values.exp() if values.is_cuda else _Exponential.apply(values.contiguous())  # type: ignore[return-value]


def sigmoid(values: Tensor) -> Tensor:
    """Return ``1 / (1 + exp(-values))`` of float32 values of any shape, to 3e-7 of the result.

    Torch's own results on a CPU change with the number of threads. On CUDA this is ``values.sigmoid()``.
    """
    return values.sigmoid() if values.is_cuda else _Sigmoid.apply(values.contiguous())  # type: ignore[return-value]
