"""Files of Gaussians; the longest suffix of the name chooses the reader."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np

from ..errors import UserError, is_shortage
from ..gaussians import SH_C0, GaussianParameters
from ..storage.suffixes import longest_suffix
from ..types import Gaussians
from .gaussian_compressed_ply import SUFFIX, write_compressed_ply
from .gaussian_ply import read_gaussian_ply, write_gaussian_ply
from .gaussian_sog import read_antialiased_model, read_sog, write_sog
from .gaussian_splat import read_splat, write_splat
from .gaussian_spz import VERSION, read_antialiased_flag, read_spz, write_spz
from .ply_header import has_antialiased_comment
from .sog_files import META

READERS: dict[str, Callable[[Path], GaussianParameters]] = {
    ".ply": read_gaussian_ply,
    SUFFIX: read_gaussian_ply,
    ".splat": read_splat,
    ".spz": read_spz,
    ".sog": read_sog,
    META: read_sog,
}
"""Readers by suffix; the folder of a SOG can be given for its ``meta.json``."""


def read_gaussians(path: str | Path) -> GaussianParameters:
    """Read raw parameters, world units, from a ``.ply`` of 3D Gaussian splatting, a ``.compressed.ply``, a ``.splat``,
    a ``.spz``, or a SOG: a ``.sog``, a ``meta.json`` or the folder that holds one.

    Raises:
        UserError: the file is of another kind, missing, damaged or too large for memory, or it has no finite Gaussian.
    """
    path = _file(path)
    reader = READERS.get(longest_suffix(path, READERS))
    if reader is None:
        raise UserError(f"{path}: Gaussians are read from {', '.join(READERS)}; give one of these or convert it")
    with shortage_as_user_error(path):
        return reader(path)


def _file(path: str | Path) -> Path:
    """Return the path itself, or the ``meta.json`` in a folder."""
    path = Path(path)
    return path / META if (path / META).is_file() else path


def read_antialiased(path: str | Path) -> bool:
    """Return whether a file is marked as trained with the antialiasing compensation; False for what cannot be read."""
    path = _file(path)
    suffix = longest_suffix(path, READERS)
    if suffix in (".ply", SUFFIX):
        return has_antialiased_comment(path)
    if suffix in (".sog", META):
        return read_antialiased_model(path)
    return suffix == ".spz" and read_antialiased_flag(path)


def write_gaussians(
    path: str | Path, gaussians: Gaussians, *, antialiased: bool = False, spz_version: Literal[3, 4] = VERSION
) -> int:
    """Write activated Gaussians, world units, in the format of the longest suffix, one of ``READERS``.

    Args:
        antialiased: whether the Gaussians were trained with the antialiasing compensation; a ``.splat`` does not record
            it.
        spz_version: version of a ``.spz``.

    Returns:
        Number of values clipped to the range of the format.

    Raises:
        UserError: the suffix is another, or the file cannot be written.
    """
    path = Path(path)
    suffix = longest_suffix(path, READERS)
    if suffix == SUFFIX:
        return write_compressed_ply(path, gaussians, antialiased=antialiased)
    if suffix == ".spz":
        return write_spz(path, gaussians, antialiased=antialiased, version=spz_version)
    if suffix == ".splat":
        return write_splat(path, gaussians)
    if suffix == ".ply":
        write_gaussian_ply(path, gaussians, antialiased=antialiased)
    elif suffix in (".sog", META):
        write_sog(path, gaussians, antialiased=antialiased)
    else:
        raise UserError(f"{path}: Gaussians are written as {', '.join(READERS)} or .glb; end the name in one of these")
    return 0


@contextmanager
def shortage_as_user_error(path: Path) -> Iterator[None]:
    """Convert a shortage of memory inside the context to a UserError about the file.

    Raises:
        UserError: memory does not suffice for all Gaussians of the file.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_shortage(error):
            raise
        raise UserError(f"{path}: holds more Gaussians than fit into memory; export it in parts") from None


def gaussian_points(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the positions [P, 3] float64 of a file's Gaussians and their colours of degree 0, [P, 3] in [0, 1].

    Raises:
        UserError: in the same cases as :func:`read_gaussians`.
    """
    gaussians = read_gaussians(path)
    colors = 0.5 + SH_C0 * gaussians.sh_dc.detach().double().numpy()
    return gaussians.means.detach().double().numpy(), colors.clip(0.0, 1.0)
