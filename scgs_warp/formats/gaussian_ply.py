"""``.ply`` files of 3D Gaussian splatting, with the property names of its reference implementation."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..errors import UserError
from ..gaussians import GaussianParameters
from ..storage.files import write_atomically
from ..storage.suffixes import longest_suffix
from ..types import Gaussians
from .gaussian_compressed_ply import SUFFIX, is_packed, unpack
from .gaussian_parameters import REST_COLUMNS, to_parameters
from .ply_header import ANTIALIASED_COMMENT, parse_ply

if TYPE_CHECKING:
    from plyfile import PlyData

OPAQUE_LOGIT = 80.0
"""Largest logit of an opacity: opaque up to rounding. It replaces infinity, which some programs write."""
FLAT = math.log(1e-30)
"""Least logarithm of a scale. It replaces that of 0, which some programs write for flat Gaussians."""


def read_gaussian_ply(path: str | Path) -> GaussianParameters:
    """Read raw parameters, world units; non-finite Gaussians are left out. A file of packed Gaussians is read, too,
    whatever its name (:mod:`.gaussian_compressed_ply`).

    Raises:
        UserError: the file is missing, is not a PLY of Gaussians, or has no finite Gaussian.
    """
    path = Path(path)
    elements = _elements(path)
    if is_packed(elements):
        return to_parameters(path, unpack(path, elements))
    data = np.asarray(elements["vertex"].data)
    if "O" in [data.dtype[name].kind for name in data.dtype.names or ()]:
        raise UserError(f"{path}: its vertices hold lists; give a .ply of 3D Gaussian splatting")
    names = set(data.dtype.names or ())
    needed = [
        "x",
        "y",
        "z",
        "opacity",
        *(f"{n}_{i}" for n, c in (("f_dc", 3), ("scale", 3), ("rot", 4)) for i in range(c)),
    ]
    missing = [name for name in needed if name not in names]
    if missing:
        raise UserError(f"{path}: vertices lack {', '.join(missing[:4])}; give a .ply of 3D Gaussian splatting")
    rest = len([name for name in names if name.startswith("f_rest_")])
    if rest not in REST_COLUMNS or any(f"f_rest_{i}" not in names for i in range(rest)):
        raise UserError(f"{path}: {rest} f_rest columns; harmonics of degree 0 to 3 have 0, 9, 24 or 45")

    def columns(*wanted: str) -> np.ndarray:
        return np.stack([np.asarray(data[name], np.float32) for name in wanted], axis=1)

    means, dc = columns("x", "y", "z"), columns("f_dc_0", "f_dc_1", "f_dc_2")
    opacity = columns("opacity")[:, 0].clip(-OPAQUE_LOGIT, OPAQUE_LOGIT)
    sh_rest = np.zeros((len(data), 0, 3), np.float32)
    if rest:  # The file stores harmonics channel by channel.
        sh_rest = columns(*(f"f_rest_{i}" for i in range(rest))).reshape(-1, 3, rest // 3).transpose(0, 2, 1)
    values = {
        "means": means, "sh_dc": dc, "sh_rest": sh_rest, "opacity_logits": opacity,
        "log_scales": np.maximum(columns("scale_0", "scale_1", "scale_2"), FLAT),
        "quats": columns("rot_0", "rot_1", "rot_2", "rot_3"),
    }  # fmt: skip
    return to_parameters(path, values)


def _elements(path: Path) -> PlyData:
    """Parse a file, and make sure that it has vertices."""
    from plyfile import PlyParseError

    if not path.is_file():
        raise UserError(f"{path}: no such file; give a .ply of 3D Gaussian splatting")
    try:
        elements = parse_ply(path)  # numbers in text may overflow to infinity; such Gaussians are left out
        data = np.asarray(elements["vertex"].data)
    except (PlyParseError, KeyError, ValueError, OverflowError, OSError, MemoryError) as error:
        raise UserError(f"{path}: no PLY file with vertices ({type(error).__name__}); export it again") from None
    if data.dtype.names is None or len(data) == 0:
        raise UserError(f"{path}: holds no vertices; give a .ply of 3D Gaussian splatting")
    return elements


def write_gaussian_ply(path: str | Path, gaussians: Gaussians, *, antialiased: bool = False) -> None:
    """Write activated Gaussians, world units, in the layout of 3D-GS: logits of opacities, logarithms of scales, unit
    quaternions, harmonics channel by channel. The file is binary, little endian; the same Gaussians give the same
    bytes. Sharp Gaussians are approximated (``Gaussians.plain``).

    Args:
        antialiased: whether the Gaussians were trained with the antialiasing compensation, which a comment records.

    Raises:
        UserError: the name does not end in .ply, or the file cannot be written.
    """
    path = Path(path)
    if longest_suffix(path, (".ply", SUFFIX)) != ".ply":
        raise UserError(f"{path}: end the name in .ply, not in {SUFFIX}")
    gaussians = gaussians.plain()
    count, rest = gaussians.means.shape[0], 3 * gaussians.sh_rest.shape[1]
    opacities = gaussians.opacities.detach().cpu().double().clamp(1e-6, 1.0 - 1e-6)
    quats = torch.nn.functional.normalize(gaussians.quats.detach().cpu().double(), dim=1)
    columns = {
        "x y z": gaussians.means,
        "nx ny nz": torch.zeros(count, 3),
        "f_dc_0 f_dc_1 f_dc_2": gaussians.sh_dc,
        " ".join(f"f_rest_{i}" for i in range(rest)): gaussians.sh_rest.permute(0, 2, 1).reshape(count, rest),
        "opacity": torch.logit(opacities)[:, None],
        "scale_0 scale_1 scale_2": gaussians.scales.detach().cpu().double().clamp_min(1e-30).log(),
        "rot_0 rot_1 rot_2 rot_3": quats,
    }
    names = [name for group in columns for name in group.split()]
    table = torch.cat([value.detach().cpu().float() for value in columns.values()], dim=1)
    head = ["ply", "format binary_little_endian 1.0", *[f"comment {ANTIALIASED_COMMENT}"] * antialiased]
    head += [f"element vertex {count}"]
    head += [f"property float {name}" for name in names] + ["end_header", ""]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{path.parent}: cannot be made ({error.strerror}); give another folder") from None
    write_atomically(path, "\n".join(head).encode() + table.numpy().astype("<f4").tobytes())
