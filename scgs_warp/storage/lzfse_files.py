"""Arrays that Apple's LZFSE compresses, as in Record3D's ``.r3d`` files."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import UserError
from .files import read_bytes

INSTALL = 'reading .depth needs imagecodecs; pip install "scgs-warp[r3d]"'


def reads_lzfse() -> bool:
    """Return whether the optional package is there."""
    return importlib.util.find_spec("imagecodecs") is not None


def read_lzfse(path: Path, kind: str, shapes: Sequence[tuple[int, int]]) -> np.ndarray:
    """Read an array of the NumPy type ``kind``, row by row, of the first of ``shapes`` that fits its size.

    Raises:
        UserError: imagecodecs is not installed, or the file is missing, damaged, or of none of the shapes.
    """
    data = read_bytes(path, "export the capture again")
    if not reads_lzfse():
        raise UserError(f"{path}: {INSTALL}")
    import imagecodecs

    sizes = {shape: math.prod(shape) * np.dtype(kind).itemsize for shape in shapes}
    try:
        # A small file may unpack to any size: no more is taken than fits, and a byte to see that there is more.
        content = imagecodecs.lzfse_decode(data, out=max(sizes.values()) + 1)
    except (RuntimeError, ValueError, TypeError):
        raise UserError(f"{path}: does not decode as LZFSE; export the capture again") from None
    shape = next((shape for shape, size in sizes.items() if size == len(content)), None)
    if shape is None:
        expected = " or ".join(f"{width} x {height}" for height, width in shapes)
        raise UserError(f"{path}: holds {len(content):,} bytes, not {expected} pixels; export the capture again")
    return np.frombuffer(content, kind).reshape(shape)
