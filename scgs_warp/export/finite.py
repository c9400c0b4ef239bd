"""Finite Gaussians: programs that open a file may fail at others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..errors import UserError
from ..types import Gaussians


def finite_rows(gaussians: Gaussians) -> np.ndarray:
    """Return [N] bool: Gaussians that are finite and whose quaternion is not zero."""
    count = len(gaussians.means)
    parts = [part.detach().reshape(count, -1).isfinite().all(dim=1) for part in gaussians.tensors().values()]
    return (torch.stack(parts).all(dim=0) & gaussians.quats.any(dim=1)).cpu().numpy()


def select_gaussians(gaussians: Gaussians, rows: np.ndarray) -> Gaussians:
    """Return the Gaussians of ``rows`` [N] bool, on the CPU."""
    chosen = torch.from_numpy(rows)
    rows_of = {name: value.detach().cpu()[chosen] for name, value in gaussians.tensors().items()}
    return replace(gaussians, **rows_of)


def keep_finite(gaussians: Gaussians) -> Gaussians:
    """Return the finite Gaussians, on the CPU.

    Raises:
        UserError: no Gaussian is finite.
    """
    rows = finite_rows(gaussians)
    if not rows.any():
        raise UserError(f"none of {len(rows)} Gaussians is finite; train again with a lower rate")
    return select_gaussians(gaussians, rows)
