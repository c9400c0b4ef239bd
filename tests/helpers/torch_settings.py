"""Settings that callers change for torch."""

from __future__ import annotations

from contextlib import contextmanager

import torch


@contextmanager
def default_dtype():
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


SETTINGS = {
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "float64": default_dtype,
    "device": lambda: torch.device("meta"),
}
