"""Adam steps over many tensors at once, and the search for a non-finite tensor. No gradients."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..kernels import adam as kernels
from ..kernels.cpu import adam as cpu_kernels
from ..kernels.types import ADAM_CHUNK
from ..runtime.device_copies import sent
from ..runtime.launch import launch
from .forms import Form, chosen_form


class Update(NamedTuple):
    """One tensor's part of a step. Its four tensors have the same shape and are contiguous float32."""

    value: Tensor
    """Parameter, changed in place."""
    gradient: Tensor
    exp_avg: Tensor
    """First moment, changed in place."""
    exp_avg_sq: Tensor
    """Second moment, changed in place."""
    rate: float
    steps: int
    """Number of steps taken, this one included: 1 or more."""


def adam_step(
    updates: Sequence[Update], *, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15, form: Form = "auto"
) -> None:
    """Take one step of Adam (Kingma and Ba 2015, algorithm 1), bias-corrected as ``torch.optim.Adam``, in one launch.

    Finite gradients beyond 1e19, whose squares would overflow, are clamped to 1e19.

    Args:
        updates: tensors on one device; empty tensors and an empty list are allowed.
        betas: decay of the first and second moment.
        eps: added to the root of the second moment after its bias correction.
        form: kernels to run: ``plain`` on any device, ``cpu`` in SIMD; ``auto`` takes the fastest for the device.

    Raises:
        ValueError: a tensor is not contiguous float32 of its value's shape on the common device, or the form is wrong.
    """
    if not updates:
        return
    device = updates[0].value.device
    form = chosen_form(form, device)
    addresses, factors = [], []
    for update in updates:
        if not _fits(update, device):
            _refuse(update, device)
        value, gradient, exp_avg, exp_avg_sq, rate, steps = update
        addresses.append((value.data_ptr(), gradient.data_ptr(), exp_avg.data_ptr(), exp_avg_sq.data_ptr()))
        factors.append((rate / (1.0 - betas[0] ** steps), (1.0 - betas[1] ** steps) ** -0.5))
    sizes, chunks = element_chunks(tuple([update.value.numel() for update in updates]), device)
    tables = table(addresses, np.int64, device), table(factors, np.float32, device), sizes, chunks
    numbers = 1.0 - betas[0], betas[1], 1.0 - betas[1], eps
    if form == "cpu":
        launch(cpu_kernels.adam_step, len(chunks), *tables, *numbers, grain=4)
    else:
        launch(kernels.adam_step, len(chunks) * ADAM_CHUNK, *tables, *numbers, None, 0)
    # As after torch's own in-place operations, a backward pass that needs the old values raises.
    torch.autograd.graph.increment_version([tensor for update in updates for tensor in (update.value, *update[2:4])])


def first_not_finite(tensors: Sequence[Tensor]) -> int | None:
    """Return the index of the first tensor with an infinity or a NaN, or None. No sum is involved that could overflow.

    Args:
        tensors: float32, on one device.
    """
    if not tensors:
        return None
    if tensors[0].device.type != "cpu":
        return first_not_finite_by_norm(tensors)
    for tensor in tensors:
        if tensor.dtype != torch.float32:
            raise ValueError(f"tensors must be float32, got {tensor.dtype}")
    tensors = [tensor if tensor.is_contiguous() else tensor.contiguous() for tensor in tensors]
    sizes, chunks = element_chunks(tuple([tensor.numel() for tensor in tensors]), tensors[0].device)
    bad = torch.empty(len(chunks), dtype=torch.int32)
    addresses = table([tensor.data_ptr() for tensor in tensors], np.int64, tensors[0].device)
    launch(cpu_kernels.find_non_finite, len(chunks), addresses, sizes, chunks, bad, grain=4)
    bad_chunks = bad.numpy().nonzero()[0]
    return int(chunks[bad_chunks[0], 0]) if len(bad_chunks) else None


def first_not_finite_by_norm(tensors: Sequence[Tensor]) -> int | None:
    """Compute the result of :func:`first_not_finite` in torch operations.

    The host waits for the device only once, unless a value is non-finite.

    Args:
        tensors: floating point, on one device. Empty tensors are skipped, because torch has no infinity norm of them.
            Stage 1 has empty gradients: its spheres have no spherical harmonics beyond degree 0.
    """
    filled = [(index, tensor) for index, tensor in enumerate(tensors) if tensor.numel() > 0]
    if not filled or math.isfinite(float(torch.nn.utils.get_total_norm([tensor for _, tensor in filled], math.inf))):
        return None
    return next(index for index, tensor in filled if not bool(torch.isfinite(tensor).all()))


def _fits(update: Update, device: torch.device) -> bool:
    """Return whether an update is valid. There is no loop, because this runs for each tensor in each step."""
    value, gradient, exp_avg, exp_avg_sq = update[:4]
    return (
        value.shape == gradient.shape == exp_avg.shape == exp_avg_sq.shape
        and value.dtype is gradient.dtype is exp_avg.dtype is exp_avg_sq.dtype is torch.float32
        and value.device == gradient.device == exp_avg.device == exp_avg_sq.device == device
        and value.is_contiguous()
        and gradient.is_contiguous()
        and exp_avg.is_contiguous()
        and exp_avg_sq.is_contiguous()
    )


def table(rows: list, dtype: type | str, device: torch.device) -> Tensor:
    """Make a tensor of a list through NumPy, which reads lists several times faster than torch does."""
    return sent(torch.from_numpy(np.array(rows, dtype)), device)


def _refuse(update: Update, device: torch.device) -> None:
    shape = update.value.shape
    for name, tensor in zip(Update._fields, update[:4]):
        if tensor.shape != shape or tensor.dtype is not torch.float32 or tensor.device != device:
            raise ValueError(
                f"{name} must be {list(shape)} float32 on {device}, "
                f"got {list(tensor.shape)} {tensor.dtype} on {tensor.device}"
            )
        if not tensor.is_contiguous():
            raise ValueError(f"{name} must be contiguous, got strides {tensor.stride()}")


@lru_cache(maxsize=16)
def element_chunks(sizes: tuple[int, ...], device: torch.device) -> tuple[Tensor, Tensor]:
    """Return sizes [T] and chunks [C, 2] (tensor, first element) of tensors with ``sizes`` elements."""
    chunks = [(i, begin) for i, size in enumerate(sizes) for begin in range(0, size, ADAM_CHUNK)]
    where = torch.tensor(chunks, dtype=torch.int64).view(-1, 2)
    return torch.tensor(sizes, dtype=torch.int64).to(device), where.to(device)
