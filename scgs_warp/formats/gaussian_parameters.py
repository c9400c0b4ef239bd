"""Conversion between the rows of a file and Gaussians, with the checks shared by all formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ..errors import UserError
from ..gaussians import GaussianParameters
from ..types import Gaussians

REST_COLUMNS = (0, 9, 24, 45)
"""Numbers of columns of harmonics above degree 0, for degrees 0 to 3."""
MAX_VALUES = {"means": 1e15, "log_scales": 80.0, "quats": 1e15}
"""Largest magnitudes of parameters, so that squares and activated values stay in the range of float32. Parameters not
listed are limited to 1e6."""


def to_parameters(path: Path, values: dict[str, np.ndarray]) -> GaussianParameters:
    """Convert rows of a file to parameters, leaving out rows that are non-finite, too large or without a rotation;
    ``left_out`` of the result is their number.

    Args:
        values: float32 arrays [N, ...], by the names of :class:`GaussianParameters`; harmonics are [N, K - 1, 3].

    Raises:
        UserError: no valid row is left.
    """
    total, rest = values["sh_rest"].shape[:2]
    good = (values["quats"] != 0).any(axis=1)
    for name, value in values.items():
        with np.errstate(invalid="ignore"):
            good &= (np.abs(value.reshape(total, -1)) <= MAX_VALUES.get(name, 1e6)).all(axis=1)  # False for NaN
    if not good.any():
        raise UserError(f"{path}: none of its {total} Gaussians is finite; export it again")
    made = GaussianParameters.empty(int(good.sum()), rest, 0, False, False, "cpu")
    made.left_out = total - len(made)
    with torch.no_grad():
        for name, value in values.items():
            rows = value if good.all() else value[good]  # Avoid copying large files needlessly.
            getattr(made, name).copy_(torch.from_numpy(np.ascontiguousarray(rows)))
    return made


def to_arrays(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Convert activated Gaussians to rows of a file, float64: ``means`` [N, 3], unit ``quats`` [N, 4] wxyz,
    ``log_scales`` [N, 3], ``opacities`` [N], ``sh_dc`` [N, 3], ``sh_rest`` [N, K - 1, 3]. Sharp Gaussians are
    approximated (``Gaussians.plain``).
    """
    parts = {name: value.detach().cpu().double() for name, value in gaussians.plain().tensors().items()}
    parts["quats"] = torch.nn.functional.normalize(parts["quats"], dim=1)
    parts["log_scales"] = parts.pop("scales").clamp_min(1e-30).log()
    return {name: value.numpy() for name, value in parts.items()}
