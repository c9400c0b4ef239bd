"""Choice of the kernels that an op runs: one stage has a readable form for any device and faster ones for some."""

from __future__ import annotations

from typing import Literal, TypeVar, get_args

import torch

Form = Literal["auto", "plain", "cpu"]
"""Forms of an op without kernels of its own for a GPU."""
GpuForm = Literal["auto", "plain", "cpu", "cuda"]
"""Forms of an op with kernels for each device."""
Chosen = TypeVar("Chosen", bound=str)


def chosen_form(form: Chosen, device: torch.device, forms: object = Form) -> Chosen:
    """Return the form that an op runs: for ``auto`` that of the device, or ``plain`` if the op has none for it.

    Args:
        form: what the op's caller asks for: ``plain``, on any device; ``cpu``, in SIMD; ``cuda``, on a GPU.
        device: device of the op's tensors.
        forms: the op's forms, a Literal.

    Raises:
        ValueError: the op has no such form, or ``cpu`` is asked for with tensors elsewhere.
    """
    *others, last = get_args(forms)
    if form not in (*others, last):
        raise ValueError(f"form must be {', '.join(others)} or {last}, got {form!r}")
    if form == "auto":
        return device.type if device.type in (*others, last) else "plain"  # type: ignore[return-value]
    if form == "cpu" and device.type != "cpu":
        raise ValueError(f"form cpu needs tensors on the CPU, got {device}")
    return form
