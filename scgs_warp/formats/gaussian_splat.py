"""``.splat`` files of the first web viewers: 32 bytes per Gaussian, no header, no view-dependent colour."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ..errors import UserError
from ..gaussians import SH_C0, GaussianParameters
from ..storage.files import read_bytes, write_atomically
from ..types import Gaussians
from .gaussian_parameters import to_parameters

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])
"""Layout of a row: position and standard deviations in the units of the ``.ply``; red, green, blue, opacity; the
quaternion wxyz as 128 + 128 q."""


def write_splat(path: str | Path, gaussians: Gaussians) -> int:
    """Write activated Gaussians in descending order of volume times opacity, for viewers that draw while loading.
    Colours, opacities and rotations are rounded to 8 bits; harmonics above degree 0 are lost. Sharp Gaussians are
    approximated (``Gaussians.plain``).

    Returns:
        Number of values that were clipped: colours outside [0, 1], by more than rounding to 8 bits changes.

    Raises:
        UserError: the file cannot be written.
    """
    gaussians = gaussians.plain()
    scales = gaussians.scales.detach().cpu().double().numpy()
    opacities = gaussians.opacities.detach().cpu().double().numpy()
    quats = torch.nn.functional.normalize(gaussians.quats.detach().cpu().double(), dim=1).numpy()
    colors = 0.5 + SH_C0 * gaussians.sh_dc.detach().cpu().double().numpy()
    rows = np.zeros(len(scales), ROW)
    rows["mean"], rows["scale"] = gaussians.means.detach().cpu().numpy(), scales
    bytes_ = np.rint(255.0 * np.column_stack([colors, opacities]))
    rows["color"] = bytes_.clip(0, 255)
    rows["quat"] = np.rint(128.0 + 128.0 * quats).clip(0, 255)
    importance = scales.prod(axis=1) * opacities
    order = np.argsort(-importance, kind="stable")
    write_atomically(Path(path), rows[order].tobytes())
    return int(((bytes_ < 0) | (bytes_ > 255)).sum())


def read_splat(path: str | Path) -> GaussianParameters:
    """Read raw parameters of degree 0, world units.

    Raises:
        UserError: the file is missing, empty or truncated, or holds no finite Gaussian.
    """
    path = Path(path)
    content = read_bytes(path, "give a .splat")
    if not content or len(content) % ROW.itemsize:
        raise UserError(f"{path}: {len(content)} bytes are not a multiple of {ROW.itemsize}; export the .splat again")
    rows = np.frombuffer(content, ROW)
    color = rows["color"].astype(np.float64) / 255.0
    opacity = color[:, 3].clip(1e-6, 1.0 - 1e-6)
    with np.errstate(invalid="ignore"):  # Rows of NaN are left out below.
        scales = np.maximum(rows["scale"].astype(np.float64), 1e-30)
    values = {
        "means": rows["mean"],
        "sh_dc": (color[:, :3] - 0.5) / SH_C0,
        "sh_rest": np.zeros((len(rows), 0, 3)),
        "opacity_logits": np.log(opacity / (1.0 - opacity)),
        "log_scales": np.log(scales),
        "quats": (rows["quat"].astype(np.float64) - 128.0) / 128.0,
    }
    return to_parameters(path, {name: value.astype(np.float32) for name, value in values.items()})
