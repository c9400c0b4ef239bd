"""Compressed ``.ply`` files (PlayCanvas, SuperSplat): 16 bytes per Gaussian, plus one byte per harmonic.

The element ``chunk`` holds the ranges of positions, logarithms of scales and, in newer files, colours of 256 Gaussians
each. The element ``vertex`` holds four words per Gaussian: position and scales within the ranges of its chunk (11, 10
and 11 bits), rotation (two bits for the largest component of wxyz, ten for each other), colour within its range and
opacity (8 bits each). The element ``sh`` holds the harmonics above degree 0, channel by channel, from -4 to 4.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from ..gaussians import SH_C0
from ..geometry.morton import morton_order
from ..storage.files import write_atomically
from ..storage.output_folders import make_parent
from ..types import Gaussians
from . import smallest_three
from .gaussian_parameters import REST_COLUMNS, to_arrays
from .ply_header import ANTIALIASED_COMMENT

SUFFIX = ".compressed.ply"
CHUNK = 256
"""Number of Gaussians with common ranges."""
RANGES = tuple(f"{end}_{axis}" for group in ("xyz", ("scale_x", "scale_y", "scale_z"), "rgb")
               for end in ("min", "max") for axis in group)  # fmt: skip
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
MAX_LOG_SCALE = 20.0
"""Largest magnitude of a logarithm of a scale."""
REST_LIMIT = 4.0
"""Magnitude at which harmonics are clipped."""
ORDER_BITS = 21
"""Cells along each axis, as a power of 2, for the order of Gaussians: enough for a scene with far outliers."""


def write_compressed_ply(path: str | Path, gaussians: Gaussians, *, antialiased: bool = False) -> int:
    """Write activated Gaussians, world units, in Morton order. The same Gaussians give the same bytes.

    Values are rounded: positions and logarithms of scales to 1 / 2047 (y: 1 / 1023) of their range in the chunk,
    colours to 1 / 255 of theirs, opacities to 8 bits, rotations to 10 bits a component, harmonics to 1 / 32. Sharp
    Gaussians are approximated (``Gaussians.plain``).

    Args:
        antialiased: whether the Gaussians were trained with the antialiasing compensation.

    Returns:
        Number of values that were clipped: scales outside [2.1e-9, 4.9e8], harmonics above degree 0 outside [-4, 4].

    Raises:
        UserError: the name does not end in .compressed.ply, or the file cannot be written.
    """
    path = Path(path)
    if not path.name.lower().endswith(SUFFIX):
        raise UserError(f"{path}: end the name in {SUFFIX}")
    rows = to_arrays(gaussians)
    order = morton_order(rows["means"], ORDER_BITS)
    rows = {name: value[order] for name, value in rows.items()}
    count = len(order)
    scales = rows["log_scales"].clip(-MAX_LOG_SCALE, MAX_LOG_SCALE)
    groups = (rows["means"], scales, 0.5 + SH_C0 * rows["sh_dc"])
    ranges, shares = zip(*(_normalise(values) for values in groups))
    largest, others = smallest_three.split(rows["quats"])
    words = (
        _join_words(shares[0], (11, 10, 11)),
        _join_words(others / (2 * smallest_three.LIMIT) + 0.5, (10, 10, 10)) | largest.astype(np.uint32) << 30,
        _join_words(shares[1], (11, 10, 11)),
        _join_words(np.column_stack([shares[2], rows["opacities"]]), (8, 8, 8, 8)),
    )
    rest = rows["sh_rest"].transpose(0, 2, 1).reshape(count, -1)  # channel by channel
    codes = np.floor((rest / (2 * REST_LIMIT) + 0.5) * 256).clip(0, 255).astype("u1")
    head = _header(count, len(ranges[0]), rest.shape[1], antialiased)
    make_parent(path)
    table = np.concatenate(ranges, axis=1).astype("<f4")
    write_atomically(
        path, b"".join([head, table.tobytes(), np.stack(words, 1).astype("<u4").tobytes(), codes.tobytes()])
    )
    return int((scales != rows["log_scales"]).sum() + (np.abs(rest) > REST_LIMIT).sum())


def _header(count: int, chunks: int, columns: int, antialiased: bool) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {ANTIALIASED_COMMENT}"] * antialiased
    lines += [f"element chunk {chunks}", *(f"property float {name}" for name in RANGES)]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in WORDS)]
    if columns:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(columns))]
    return "\n".join([*lines, "end_header", ""]).encode()


def _normalise(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ranges [C, 6] of all chunks, minima first, and the values' shares [N, 3] of them, from 0 to 1."""
    starts = np.arange(0, len(values), CHUNK)
    values = values.astype(np.float32).astype(np.float64)  # the precision of the ranges
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    chunk = np.arange(len(values)) // CHUNK
    width = np.where(high > low, high - low, 1.0)
    return np.concatenate([low, high], axis=1), (values - low[chunk]) / width[chunk]


def _join_words(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Join shares [N, C] from 0 to 1, with so many bits each, to words [N] uint32; the first is highest."""
    word = np.zeros(len(shares), np.uint32)
    for column, count in enumerate(bits):
        top = (1 << count) - 1
        word = word << np.uint32(count) | np.rint(shares[:, column] * top).clip(0, top).astype(np.uint32)
    return word


def _split_words(word: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Split words [N] to shares [N, C] float64 from 0 to 1: the inverse of :func:`_join_words`."""
    shares, shift = np.empty((len(word), len(bits))), sum(bits)
    for column, count in enumerate(bits):
        shift -= count
        top = (1 << count) - 1
        shares[:, column] = (word >> np.uint32(shift) & np.uint32(top)) / top
    return shares


def is_packed(elements: Any) -> bool:
    """Return whether a parsed PLY (``plyfile.PlyData``) announces packed Gaussians, whatever the file's name."""
    names = {element.name for element in elements.elements}
    return "chunk" in names and "vertex" in names and WORDS[0] in elements["vertex"]


def unpack(path: Path, elements: Any) -> dict[str, np.ndarray]:
    """Return the rows of a parsed PLY of packed Gaussians, as ``gaussian_parameters.to_parameters`` takes them.

    Raises:
        UserError: an element lacks a property, or the numbers of rows do not fit together.
    """
    words = _table(path, elements, "vertex", WORDS, "u4")
    count = len(words)
    colored = "min_r" in elements["chunk"]
    ranges = _table(path, elements, "chunk", RANGES if colored else RANGES[:12], "f4").astype(np.float64)
    if len(ranges) != -(-count // CHUNK):
        raise UserError(
            f"{path}: {len(ranges)} chunks for {count} Gaussians; there is one for each {CHUNK}: export it again"
        )
    chunk = np.arange(count) // CHUNK

    def spread(shares: np.ndarray, group: int) -> np.ndarray:
        low, high = ranges[chunk, 6 * group : 6 * group + 3], ranges[chunk, 6 * group + 3 : 6 * group + 6]
        return low * (1 - shares) + high * shares

    color = _split_words(words[:, 3], (8, 8, 8, 8))
    opacity = color[:, 3].clip(1e-6, 1.0 - 1e-6)
    others = (_split_words(words[:, 1], (10, 10, 10)) - 0.5) * (2 * smallest_three.LIMIT)
    with np.errstate(over="ignore", invalid="ignore"):  # Gaussians of such ranges are left out.
        values = {
            "means": spread(_split_words(words[:, 0], (11, 10, 11)), 0),
            "sh_dc": ((spread(color[:, :3], 2) if colored else color[:, :3]) - 0.5) / SH_C0,
            "opacity_logits": np.log(opacity / (1.0 - opacity)),
            "log_scales": spread(_split_words(words[:, 2], (11, 10, 11)), 1),
            "quats": smallest_three.join(words[:, 1] >> np.uint32(30), others),
        }
        return {name: value.astype(np.float32) for name, value in values.items()} | {
            "sh_rest": _unpack_rest(path, elements, count)
        }


def _unpack_rest(path: Path, elements: Any, count: int) -> np.ndarray:
    """Return the harmonics [N, K - 1, 3] float32."""
    if "sh" not in {element.name for element in elements.elements}:
        return np.zeros((count, 0, 3), np.float32)
    columns = len(elements["sh"].properties)
    if columns not in REST_COLUMNS:
        raise UserError(f"{path}: {columns} columns of harmonics; degrees 0 to 3 have 0, 9, 24 or 45: export it again")
    codes = _table(path, elements, "sh", tuple(f"f_rest_{i}" for i in range(columns)), "u1")
    if len(codes) != count:
        raise UserError(f"{path}: {len(codes)} rows of harmonics for {count} Gaussians; export it again")
    share = (np.arange(256) + 0.5) / 256  # the middle of each step, except for the first and the last
    share[[0, 255]] = 0, 1
    values = ((share - 0.5) * (2 * REST_LIMIT)).astype(np.float32)[codes]
    return values.reshape(count, 3, columns // 3).transpose(0, 2, 1)


def _table(path: Path, elements: Any, element: str, names: tuple[str, ...], kind: str) -> np.ndarray:
    """Return properties of an element as columns [N, C]."""
    data = np.asarray(elements[element].data)
    for name in names:
        found = data.dtype[name] if name in (data.dtype.names or ()) else None
        if found is None or found.str[1:] != kind:
            words = {"u4": "unsigned words of 32 bits", "f4": "floats", "u1": "bytes"}[kind]
            raise UserError(f"{path}: {element} has no {name} that holds {words}; export the file again")
    return np.stack([np.asarray(data[name]) for name in names], axis=1).astype(f"={kind}").reshape(len(data), -1)
