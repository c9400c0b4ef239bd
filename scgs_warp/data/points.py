"""Initial points of a data set, from files of points or of Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import UserError
from ..formats.gaussian_compressed_ply import is_packed
from ..formats.gaussian_files import READERS, gaussian_points
from ..formats.ply_header import parse_ply
from ..gaussians import SH_C0
from ..storage.safe_paths import is_regular
from ..storage.suffixes import longest_suffix


def finite_points(points: np.ndarray) -> np.ndarray:
    """Return [P] bool, True for points [P, 3] float64 that are finite in float32, the precision of training."""
    with np.errstate(over="ignore"):
        return np.all(np.isfinite(points.astype(np.float32)), axis=1)


def unit_colors(vertices: np.ndarray) -> np.ndarray | None:
    """Return colours [P, 3] in [0, 1], grey where they are non-finite; None if the file has no colours.

    Integers are divided by the largest value of their type, floats by 255 if any of them exceeds 1. For a file of
    Gaussians, the colours are those of the harmonics of degree 0.
    """
    names = ("red", "green", "blue")
    harmonics = [f"f_dc_{channel}" for channel in range(3)]
    if all(name in (vertices.dtype.names or ()) for name in harmonics):
        raw = np.stack([np.asarray(vertices[name], np.float64) for name in harmonics], axis=1)
        return np.where(np.isfinite(raw), 0.5 + SH_C0 * raw, 0.5).clip(0.0, 1.0)
    if not all(name in (vertices.dtype.names or ()) for name in names):
        return None
    raw = np.stack([np.asarray(vertices[name]) for name in names], axis=1)
    if np.issubdtype(raw.dtype, np.integer):
        return (raw / np.iinfo(raw.dtype).max).clip(0.0, 1.0)
    colors = raw.astype(np.float64)
    finite = np.isfinite(colors)
    most = 255.0 if (colors[finite] > 1.0).any() else 1.0
    return np.where(finite, colors / most, 0.5).clip(0.0, 1.0)


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Read initial points [P, 3] float64 and their colours [P, 3] in [0, 1] from a PLY file of points or of Gaussians,
    or from the Gaussians of another file.

    Raises:
        UserError: in the same cases as :func:`read_ply` and ``gaussian_files.read_gaussians``.
    """
    if longest_suffix(path, READERS) not in ("", ".ply"):
        return gaussian_points(path)
    return read_ply(path)


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Read the vertices [P, 3] float64 of a PLY file and their colours [P, 3] in [0, 1]; None without colours.

    Points that are non-finite in float32 are left out.

    Raises:
        UserError: the file is missing, is not a PLY, lacks x, y or z, or announces more points than fit into memory.
    """
    from plyfile import PlyParseError

    try:
        if not is_regular(path):
            raise UserError(f"{path}: is not a regular file; give a PLY of points")
        elements = parse_ply(path)  # numbers in text may overflow to infinity; such points are left out
        if is_packed(elements):
            return gaussian_points(path)
        vertices = elements["vertex"].data
        points = np.stack([np.asarray(vertices[axis], np.float64) for axis in "xyz"], axis=1)
        colors = unit_colors(vertices)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file, though ply_file_path names it; restore it or drop the field") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); make the file readable") from None
    except (PlyParseError, KeyError, ValueError, TypeError):
        raise UserError(f"{path}: no PLY file of vertices with x, y, z; export the points again") from None
    except (MemoryError, OverflowError):
        raise UserError(f"{path}: says it has more points than fit into memory; export the points again") from None
    kept = finite_points(points)
    return points[kept], None if colors is None else colors[kept]


def write_points(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write a binary PLY file of points [P, 3] and colours [P, 3] uint8."""
    from plyfile import PlyData, PlyElement

    fields = [*((axis, "<f4") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    rows = np.empty(len(points), fields)
    for k, (name, _) in enumerate(fields):
        rows[name] = (points if k < 3 else colors)[:, k % 3]
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))
