"""What all readers share: JSON, numpy files, numbers, names in their natural order, held-out frames."""

from __future__ import annotations

import json
import math
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from ..errors import UserError
from .safe_paths import is_regular

HELD_OUT_EVERY = 8
HELD_OUT_FIRST = 4
"""Where the data list no splits, frames 4, 12, 20, ... are held out: never the first, so that nothing has to be
extrapolated."""
MOST_BYTES = 2**28
"""An array of a data set is smaller than this; beyond, its header is damaged, or a small archive unpacks to it."""
RIGID_TOLERANCE = 1e-3
"""Largest entry of R^T R - I that passes as rounding."""


def parse_json(text: str | bytes, **hooks: Any) -> Any:
    """As ``json.loads``, which gives up on brackets that are nested too deeply in an error of its own.

    Raises:
        ValueError: no JSON; ``json.JSONDecodeError`` where it is known where.
    """
    try:
        return json.loads(text, **hooks)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def size_text(size: Sequence[int]) -> str:
    return f"{size[0]} x {size[1]} pixels"


def as_number(value: Any) -> float | None:
    """A finite number as float; None for anything else (bool and strings too)."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def as_array(value: Any, *shapes: tuple[int, ...]) -> np.ndarray | None:
    """Finite float64 of one of these shapes; None for anything else."""
    try:
        array = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        return None
    return array if array.shape in shapes and np.isfinite(array).all() else None


def is_rotation(matrix: np.ndarray) -> bool:
    """Whether [3, 3] turns without scaling, shearing or mirroring, but for rounding."""
    if not np.abs(matrix).max() < 2.0:  # also NaN, and what would overflow
        return False
    return float(np.abs(matrix.T @ matrix - np.eye(3)).max()) <= RIGID_TOLERANCE and float(np.linalg.det(matrix)) > 0


def natural(text: str) -> list[tuple[int, str]]:
    """A key that sorts frame_9 before frame_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", text) if part]


def by_name(files: Sequence[Path]) -> list[int]:
    """The files' indices in the natural order of their names."""
    return sorted(range(len(files)), key=lambda index: natural(files[index].as_posix()))


def held_out(path: Path, order: Sequence[int], split: str) -> list[int]:
    """Indices of this split, ascending, where every eighth in ``order`` is held out, for ``test`` and ``val`` alike.

    Raises:
        UserError: nothing is left; names ``path``.
    """
    outside = set(order[min(HELD_OUT_FIRST, len(order) - 1) :: HELD_OUT_EVERY])
    chosen = [index for index in sorted(order) if (index in outside) != (split == "train")]
    if not chosen:
        raise UserError(f"{path}: one frame cannot be both trained on and held out; list at least two frames")
    return chosen


def read_bytes(path: Path, remedy: str) -> bytes:
    """All of a file. ``remedy``: what to do without it.

    Raises:
        UserError: no such file, or it cannot be read.
    """
    try:
        if not is_regular(path):
            raise UserError(f"{path}: is no file; {remedy}")
        return path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; {remedy}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); {remedy}") from None


def read_json(path: Path, needed: str = "restore it") -> dict[str, Any]:
    """The JSON object in ``path``. ``needed``: why it is, or what to do, if the file is missing.

    Raises:
        UserError: no such file, no JSON, no object.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; {needed}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read as UTF-8 text ({type(error).__name__}); restore the file") from None
    try:
        content = parse_json(text)
    except json.JSONDecodeError as error:
        raise UserError(
            f"{path}: not valid JSON, line {error.lineno} column {error.colno}: {error.msg}; restore or correct it"
        ) from None
    except ValueError as error:  # nested too deeply, or of Python: it converts no more than 4,300 digits
        reason = "JSON nested too deeply" if "nested" in str(error) else "holds a number of more than 4,300 digits"
        raise UserError(f"{path}: {reason}; restore or correct the file") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: holds no JSON object; restore the file")
    return content


def read_npy(path: Path, member: str | None = None, flags: bool = False) -> np.ndarray:
    """A numeric array of a .npy file, or of the ``member`` of a .npz file; float64. ``flags``: of booleans instead.

    Raises:
        UserError: the file is missing, damaged, or claims to hold more than it does.
    """
    try:
        if not is_regular(path):
            raise UserError(f"{path}: is no file; restore it")
        if member is None:
            with path.open("rb") as file:
                array = _numbers(file, path.stat().st_size, flags)
        else:
            with zipfile.ZipFile(path) as archive:
                info = archive.getinfo(f"{member}.npy")
                with archive.open(info) as file:
                    array = _numbers(file, info.file_size, flags)
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


def _numbers(file: IO[bytes], size: int, flags: bool) -> np.ndarray:
    """Read as numpy would, but nothing before the header is known to be true."""
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError("version")
    shape, fortran, kind = readers[version](file)
    count = math.prod(shape)
    if kind.kind not in ("b" if flags else "fiu") or not 0 <= count * kind.itemsize <= min(size, MOST_BYTES):
        raise ValueError("size")
    data = file.read(count * kind.itemsize)
    array = np.frombuffer(data, kind, count).reshape(shape, order="F" if fortran else "C")
    with np.errstate(invalid="ignore"):  # of signalling NaN
        return array.copy() if flags else array.astype(np.float64)


def check_ply_counts(path: Path) -> None:
    """Refuse a PLY file whose header counts more than its bytes can hold, before anybody makes room for them.

    Raises:
        ValueError: it does.
        OSError: it cannot be read.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(1 << 16).split(b"end_header")[0]
    for line in head.splitlines():
        words = line.split()
        if len(words) == 3 and words[0] == b"element" and words[2].isdigit() and int(words[2][:20]) > size:
            raise ValueError(f"counts {words[2][:20].decode()} rows in {size} bytes")
