"""The containers of ``.spz``: one gzip stream up to version 3, a plain header and zstd streams from version 4 on.

Both hold the same arrays: positions, opacities, colours of degree 0, scales, rotations, harmonics. Sizes are checked
against the header before anything is decompressed, and check sums after it.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from ..errors import UserError

MAGIC = 0x5053474E
ANTIALIASED, EXTENDED = 1, 2
"""Flags: trained with the antialiasing compensation; extensions follow."""
SH_COUNTS = (0, 3, 8, 15, 24)
"""Numbers of coefficients above degree 0, for maximum degrees 0 to 4."""
MAX_GAUSSIANS = 10_000_000
"""Largest number of Gaussians in a file."""
MAX_GZIP_RATIO = 1040
"""Largest number of bytes to which one byte of a gzip stream can decompress."""
MAX_EXTENSIONS = 1 << 16
"""Largest number of bytes of extensions."""
AXES_EXTENSION = 0xADBE0003
"""Type of the extension that names the axes of the positions."""
STREAMS_HEAD = struct.Struct("<IIIBBBBI12x")
HEAD = struct.Struct("<IIIBBBB")
ZSTD_LEVEL = 12
REMEDY = "export the .spz again"


@dataclass(frozen=True)
class SpzHead:
    """Header of a file."""

    version: int
    count: int
    degree: int
    bits: int
    """Number of fractional bits of positions."""
    flags: int = 0
    extensions: bytes = b""

    def sizes(self) -> list[int]:
        """Return the number of bytes of each array."""
        place, turn = 6 if self.version == 1 else 9, 4 if self.version >= 3 else 3
        return [self.count * size for size in (place, 1, 3, 3, turn, 3 * SH_COUNTS[self.degree])]

    def axes(self) -> int | None:
        """Return the number by which an extension names the axes; None if there is none."""
        left = self.extensions
        while len(left) >= 8:
            kind, size = struct.unpack_from("<II", left)
            if kind == AXES_EXTENSION and size == 4 and len(left) >= 12:
                return struct.unpack_from("<I", left, 8)[0]
            left = left[8 + size :]
        return None


def pack_gzip(head: SpzHead, parts: list[np.ndarray]) -> bytes:
    """Return the bytes of a file of version 2 or 3."""
    start = HEAD.pack(MAGIC, head.version, head.count, head.degree, head.bits, head.flags, 0)
    return gzip.compress(start + b"".join(part.tobytes() for part in parts), mtime=0)


def pack_streams(path: Path, head: SpzHead, parts: list[np.ndarray]) -> bytes:
    """Return the bytes of a file of version 4, with a check sum in each stream.

    Raises:
        UserError: the package zstandard is missing.
    """
    zstandard = _import_zstandard(path, "written", ", or give --spz-version 3")
    packer = zstandard.ZstdCompressor(level=ZSTD_LEVEL, write_checksum=True)
    plain = [part.tobytes() for part in parts if part.size]
    packed = [packer.compress(part) for part in plain]
    start = STREAMS_HEAD.pack(
        MAGIC, head.version, head.count, head.degree, head.bits, head.flags, len(plain), STREAMS_HEAD.size
    )
    table = b"".join(struct.pack("<QQ", len(small), len(large)) for small, large in zip(packed, plain))
    return b"".join([start, table, *packed])


def _import_zstandard(path: Path, done: str, otherwise: str = "") -> ModuleType:
    try:
        import zstandard
    except ImportError:
        raise UserError(
            f"{path}: a .spz of version 4 is {done} with the package zstandard: pip install zstandard{otherwise}"
        ) from None
    return zstandard


def unpack(path: Path, content: bytes) -> tuple[SpzHead, list[np.ndarray]]:
    """Return the header and the arrays, as bytes (uint8).

    Raises:
        UserError: the file is damaged or of another version, or the package zstandard is missing.
    """
    if content[:4] == struct.pack("<I", MAGIC):
        return _unpack_streams(path, content)
    return _unpack_gzip(path, content)


def _check(path: Path, head: SpzHead) -> None:
    if not 1 <= head.version <= 4:
        raise UserError(f"{path}: version {head.version} of .spz; 1 to 4 are read: convert it, for example to .ply")
    if head.count == 0 or head.degree >= len(SH_COUNTS):
        raise UserError(
            f"{path}: {head.count} Gaussians with harmonics of degree {head.degree}; at least 1 of degree 0 to 4"
        )
    if head.count > MAX_GAUSSIANS:
        raise UserError(
            f"{path}: says it holds {head.count:,} Gaussians; up to {MAX_GAUSSIANS:,} are read: {REMEDY} in parts"
        )


def _unpack_gzip(path: Path, content: bytes) -> tuple[SpzHead, list[np.ndarray]]:
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        magic, version, count, degree, bits, flags, _ = HEAD.unpack(stream.decompress(content, HEAD.size))
    except (zlib.error, struct.error):
        raise UserError(f"{path}: neither a gzip stream nor a .spz of version 4; {REMEDY}") from None
    if magic != MAGIC:
        raise UserError(f"{path}: a gzip stream of something else than Gaussians; give a .spz")
    head = SpzHead(version, count, degree, bits, flags)
    _check(path, head)
    total = sum(head.sizes())
    if total > MAX_GZIP_RATIO * len(content):
        raise UserError(f"{path}: cut short: {len(content):,} bytes cannot hold {count:,} Gaussians; {REMEDY}")
    try:  # The header bounds the sizes. zlib compares the check sum when it reaches the end.
        rows = stream.decompress(stream.unconsumed_tail, total)
        rest = stream.decompress(stream.unconsumed_tail, MAX_EXTENSIONS + 1)
    except zlib.error:
        raise UserError(f"{path}: damaged, its check sum differs; {REMEDY}") from None
    if len(rows) != total or not stream.eof:
        raise UserError(f"{path}: cut short or damaged; {REMEDY}")
    head = SpzHead(version, count, degree, bits, flags, rest if flags & EXTENDED else b"")
    return head, np.split(np.frombuffer(rows, "u1"), np.cumsum(head.sizes())[:-1])


def _unpack_streams(path: Path, content: bytes) -> tuple[SpzHead, list[np.ndarray]]:
    """Read one stream for each array that is not empty."""
    zstandard = _import_zstandard(path, "read")
    parts = []
    try:
        _, version, count, degree, bits, flags, streams, table = STREAMS_HEAD.unpack_from(content)
        extensions = content[STREAMS_HEAD.size : table][:MAX_EXTENSIONS] if flags & EXTENDED else b""
        head = SpzHead(version, count, degree, bits, flags, extensions)
        _check(path, head)
        sizes = head.sizes()
        used = [size for size in sizes if size]
        if streams != len(used) or table < STREAMS_HEAD.size:
            raise ValueError
        offset, decoder = table + 16 * streams, zstandard.ZstdDecompressor()
        for index, size in enumerate(used):
            packed, plain = struct.unpack_from("<QQ", content, table + 16 * index)
            if plain != size or offset + packed > len(content):
                raise ValueError
            parts.append(_decompress(zstandard, decoder, content[offset : offset + packed], size))
            offset += packed
        if offset != len(content):
            raise ValueError
    except (struct.error, zstandard.ZstdError, ValueError, MemoryError, OverflowError):
        raise UserError(f"{path}: cut short or damaged; {REMEDY}") from None
    return head, [*parts, *[np.zeros(0, "u1")] * (len(sizes) - len(parts))]


def _decompress(zstandard: ModuleType, decoder: object, packed: bytes, size: int) -> np.ndarray:
    """Decompress a whole frame of ``size`` bytes; a size that the frame claims is not trusted.

    Raises:
        ValueError, zstandard.ZstdError: the frame holds another number of bytes, is cut short, is followed by
            something, or its check sum differs.
    """
    claimed = zstandard.frame_content_size(packed)
    if claimed not in (-1, size):  # -1: the frame does not say
        raise ValueError
    plain = decoder.decompress(packed, max_output_size=size, allow_extra_data=False)  # type: ignore[attr-defined]
    if len(plain) != size:
        raise ValueError
    return np.frombuffer(plain, "u1")
