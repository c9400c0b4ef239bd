"""Packing of a page's data as columns of small integers; docs/page.md describes the layout.

A column is quantised to as many bits as its precision needs. Its codes are stored plane by plane: all lowest bytes,
then all second bytes, and so on. Deflate compresses each plane to about the bits that its values use, and the reader
needs a single loop.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import UserError

VERSION = 1
COMMON, SPREAD = 0.999, 2.0
"""Bounds of a column's common range: ``SPREAD`` times the quantile ``COMMON`` of the values' magnitudes. If a column
has too few bits for all of its values, outliers are clipped to this range, so that they do not coarsen the others."""
LEVEL = 6
"""Compression level of deflate. The highest level takes four times as long and saves only half a percent."""


@dataclass(frozen=True)
class Column:
    """Sequence of numbers ``low + step * code`` with codes of ``bits`` bits."""

    name: str
    codes: np.ndarray
    """[R] uint32 < 2 ** bits."""
    bits: int
    low: float = 0.0
    step: float = 1.0
    delta: bool = False
    """True if differences of neighbours, modulo 2 ** bits, are stored: for values that change slowly along the rows."""

    def values(self) -> np.ndarray:
        """Return the decoded values, [R] float64."""
        return self.low + self.step * self.codes.astype(np.float64)

    def planes(self) -> bytes:
        """Return the stored bytes, lowest plane first."""
        codes = self.codes.astype(np.uint32)
        if self.delta:
            codes = np.diff(codes, prepend=np.uint32(0)) & np.uint32((1 << self.bits) - 1)
        return b"".join(((codes >> (8 * k)) & 0xFF).astype(np.uint8).tobytes() for k in range(-(-self.bits // 8)))

    def header(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "rows": len(self.codes),
            "bits": self.bits,
            "low": self.low,
            "step": self.step,
            "delta": self.delta,
        }


def quantise(name: str, values: np.ndarray, step: float, *, most_bits: int = 24, delta: bool = False) -> Column:
    """Quantise ``values`` [R] in steps of at most ``step``; the least and the largest value are exact. If ``most_bits``
    (1 to 24) do not suffice, outliers are clipped to the common range. If that is not enough, the steps widen.

    Raises:
        UserError: a value is not finite.
    """
    values = values.astype(np.float64)
    if not np.isfinite(values).all():
        raise UserError(f"web page: {name} is not finite; train again with a lower rate")
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    if (room := ((1 << most_bits) - 1) * step) < high - low:
        reach = max(common_size(values), room / 2)
        low, high = max(low, -reach), min(high, reach)
        values = values.clip(low, high)
    bits = min(most_bits, max(1, math.ceil(math.log2((high - low) / step + 1.0))))
    width = (high - low) / ((1 << bits) - 1)
    codes = np.zeros(len(values), np.uint32) if width == 0 else np.rint((values - low) / width).astype(np.uint32)
    return Column(name, codes, bits, low, width, delta)


def common_size(values: np.ndarray) -> float:
    """Return the magnitude beyond which values of a sequence [R] are outliers."""
    return SPREAD * float(np.quantile(np.abs(values), COMMON))


def integers(name: str, values: np.ndarray, *, delta: bool = False) -> Column:
    """Store whole numbers >= 0, [R], exactly."""
    largest = int(values.max()) if len(values) else 0
    return Column(name, values.astype(np.uint32), max(1, largest.bit_length()), delta=delta)


def pack(facts: dict[str, Any], columns: list[Column], level: int = LEVEL) -> bytes:
    """Pack facts and columns: length of the header (little endian, 4 bytes), header (JSON), planes, all deflated. The
    same input gives the same bytes."""
    described = {"version": VERSION, **facts, "columns": [column.header() for column in columns]}
    header = json.dumps(described, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    header += b" " * (-len(header) % 4)
    packer = zlib.compressobj(level)
    parts = [packer.compress(struct.pack("<I", len(header)) + header)]
    parts += [packer.compress(column.planes()) for column in columns]
    return b"".join([*parts, packer.flush()])


def unpack(content: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Invert :func:`pack` as the page does: return the facts, and the values [R] float64 of every column by name."""
    raw = zlib.decompress(content)
    (length,) = struct.unpack_from("<I", raw)
    facts = json.loads(raw[4 : 4 + length])
    offset, values = 4 + length, {}
    for column in facts.pop("columns"):
        rows, bits = column["rows"], column["bits"]
        codes = np.zeros(rows, np.uint32)
        for k in range(-(-bits // 8)):
            codes |= np.frombuffer(raw, np.uint8, rows, offset).astype(np.uint32) << np.uint32(8 * k)
            offset += rows
        if column["delta"]:
            codes = np.cumsum(codes, dtype=np.uint32) & np.uint32((1 << bits) - 1)
        values[column["name"]] = column["low"] + column["step"] * codes.astype(np.float64)
    return facts, values
