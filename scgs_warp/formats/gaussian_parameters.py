"""Rows of a file to Gaussian parameters: checks that every format shares."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ..errors import UserError
from ..gaussians import GaussianParameters

MAX_VALUES = {"means": 1e15, "log_scales": 80.0, "quats": 1e15}
"""Of parameters: their squares, and what they activate to, are float32. The others are colours."""


def to_parameters(path: Path, values: dict[str, np.ndarray]) -> GaussianParameters:
    """Rows that a file held as parameters, without those that are not finite, beyond what can be drawn, or without a
    rotation.

    Args:
        values: float32, by the names of :class:`GaussianParameters`, [N, ...]; harmonics [N, K - 1, 3].

    Raises:
        UserError: no row is left.
    """
    total, rest = values["sh_rest"].shape[:2]
    good = (values["quats"] != 0).any(axis=1)
    for name, value in values.items():
        with np.errstate(invalid="ignore"):
            good &= (np.abs(value.reshape(total, -1)) <= MAX_VALUES.get(name, 1e6)).all(axis=1)  # NaN: no
    if not good.any():
        raise UserError(f"{path}: none of its {total} Gaussians is finite; export it again")
    made = GaussianParameters.empty(int(good.sum()), rest, 0, False, "cpu")
    with torch.no_grad():
        for name, value in values.items():
            rows = value if good.all() else value[good]  # large files are not copied for nothing
            getattr(made, name).copy_(torch.from_numpy(np.ascontiguousarray(rows)))
    return made
