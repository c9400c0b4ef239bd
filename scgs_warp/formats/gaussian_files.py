"""Files of Gaussians; the reader is chosen by the suffix."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..errors import UserError, is_shortage
from ..gaussians import SH_C0, GaussianParameters
from .gaussian_ply import read_gaussian_ply
from .gaussian_splat import read_splat
from .gaussian_spz import read_spz

READERS = {".ply": read_gaussian_ply, ".splat": read_splat, ".spz": read_spz}


def read_gaussians(path: str | Path) -> GaussianParameters:
    """Read raw parameters, world units, from a ``.ply`` of 3D Gaussian splatting, a ``.splat`` or a ``.spz``.

    Raises:
        UserError: the file is of another kind, missing, damaged or too large for memory, or it has no finite Gaussian.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise UserError(f"{path}: Gaussians are read from {', '.join(READERS)}; give one of these or convert it")
    with shortage_as_user_error(path):
        return reader(path)


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
