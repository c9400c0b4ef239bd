"""NumPy arrays from files that others wrote: bounded in size, without pickle."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO, Literal

import numpy as np

from ..errors import UserError
from .safe_paths import is_regular

MAX_ARRAY_BYTES = 2**28
"""Largest array accepted. A larger one means a damaged header, or a small archive that unpacks to a huge array."""

Content = Literal["numbers", "flags", "texts"]
_KINDS: dict[Content, str] = {"numbers": "fiu", "flags": "b", "texts": "U"}


def read_npy(path: Path, member: str | None = None, content: Content = "numbers") -> np.ndarray:
    """Read an array from a .npy file, or from a ``member`` of a .npz file.

    Args:
        content: ``numbers``, returned as float64; ``flags``, booleans; or ``texts``.

    Raises:
        UserError: the file is missing or damaged, or its header announces more data than it holds.
    """
    try:
        if not is_regular(path):
            raise UserError(f"{path}: not a file; restore it")
        if member is None:
            with path.open("rb") as file:
                array = _read_array(file, path.stat().st_size, content)
        else:
            with zipfile.ZipFile(path) as archive:
                info = archive.getinfo(f"{member}.npy")
                with archive.open(info) as file:
                    array = _read_array(file, info.file_size, content)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; restore it") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or 'damaged'}); restore the file") from None
    except KeyError:
        raise UserError(f"{path}: holds no array named {member!r}; restore the file") from None
    except UserError:
        raise
    except Exception as error:  # damaged headers and archives fail in many ways
        raise UserError(f"{path}: no sound numpy file ({type(error).__name__}); restore the file") from None
    return array


def _read_array(file: IO[bytes], size: int, content: Content) -> np.ndarray:
    """Read an array as NumPy does, but check that the header is plausible before allocating memory."""
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError("version")
    shape, fortran, kind = readers[version](file)
    count = math.prod(shape)
    if kind.kind not in _KINDS[content] or not 0 <= count * kind.itemsize <= min(size, MAX_ARRAY_BYTES):
        raise ValueError("size")
    data = file.read(count * kind.itemsize)
    array = np.frombuffer(data, kind, count).reshape(shape, order="F" if fortran else "C")
    if content == "texts":
        array.tolist()  # Bytes that are no characters raise an error here, not where a text is used.
    with np.errstate(invalid="ignore"):  # signalling NaN would warn
        return array.astype(np.float64) if content == "numbers" else array.copy()
