"""``.spz`` files (Niantic): Gaussians of 20 to 64 bytes before compression.

A header of 16 bytes is followed by arrays: positions (24-bit fixed point), opacities, colours of degree 0, logarithms
of scales (a byte each), rotations, harmonics (coefficient by coefficient, channels innermost). Versions 1 to 3 are one
gzip stream; version 4 is a plain header of 32 bytes, a table and one zstd stream per array.
Positions are in a frame with x right, y up, z back; a ``.ply`` has x right, y down, z forward.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from pathlib import Path

import numpy as np
import torch

from ..errors import UserError
from ..gaussians import GaussianParameters
from ..storage.files import read_bytes, write_atomically
from ..types import Gaussians
from .gaussian_parameters import to_parameters

MAGIC = 0x5053474E
VERSION = 3
"""Version to write: the last that a plain gzip reader can open, and the first with four bytes per rotation."""
ANTIALIASED = 1
COLOR_SCALE = 0.15
"""Factor on coefficients of degree 0: a byte of colour is ``127.5 + 255 * COLOR_SCALE * sh_dc``."""
SCALE_STEPS, SCALE_OFFSET = 16.0, 10.0
"""Parameters of the logarithmic encoding: a byte of scale is ``SCALE_STEPS * (log(scale) + SCALE_OFFSET)``, in steps of
6 %, from 4.5e-5 to 377."""
POSITION_BITS = 16
"""Resolution of positions: they are rounded to (size of the scene) / ``2 ** POSITION_BITS``."""
MAX_FRACTION_BITS = 24
MAX_GAUSSIANS = 10_000_000
"""Largest number of Gaussians in a file, as in the format's reference reader."""
SH_COUNTS = (0, 3, 8, 15)
"""Numbers of coefficients above degree 0, for maximum degrees 0 to 3."""
FLIPS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""Signs by which a half turn about x multiplies the harmonics of degrees 1 to 3."""
SQRT_HALF = math.sqrt(0.5)
MAX_GZIP_RATIO = 1040
"""Largest number of bytes to which one byte of a gzip stream can decompress."""
REMEDY = "export the .spz again"


def fraction_bits(means: np.ndarray) -> int:
    """Choose the number of fractional bits for positions [N, 3], limited by the range of 24 bits.

    Raises:
        UserError: a position is beyond 2^23.
    """
    middle = np.median(means, axis=0)
    extent = float(np.quantile(np.abs(means - middle).max(axis=1), 0.95)) or 1.0
    wanted = POSITION_BITS - math.floor(math.log2(extent))
    reach = float(np.abs(means).max()) or 1.0
    room = math.floor(math.log2((2**23 - 1) / reach))
    if room < 0:
        raise UserError(f"a Gaussian lies {reach:.3g} from the origin; .spz holds up to 8.3e6: make the scene smaller")
    return max(0, min(wanted, room, MAX_FRACTION_BITS))


def write_spz(path: str | Path, gaussians: Gaussians, *, antialiased: bool = False) -> int:
    """Write activated Gaussians, world units, as version 3.

    Values are rounded: positions to ``2 ** -fraction_bits``, opacities and colours to 8 bits, scales to 6 %, rotations
    to 10 bits a component, harmonics to 1 / 128 within [-1, 1]. Sharp Gaussians are approximated (``Gaussians.plain``).

    Args:
        antialiased: whether the Gaussians were trained with the antialiasing compensation.

    Returns:
        Number of values that were clipped to the range of a byte: scales outside [4.5e-5, 377], harmonics of degrees 1
        to 3 outside [-1, 1], harmonics of degree 0 outside [-3.3, 3.3].

    Raises:
        UserError: the file cannot be written, or the scene is too large for the format.
    """
    gaussians = gaussians.plain()
    means = gaussians.means.detach().cpu().double().numpy() * (1, -1, -1)
    bits = fraction_bits(means)
    fixed = np.rint(means * 2.0**bits).astype("<i4")
    quats = torch.nn.functional.normalize(gaussians.quats.detach().cpu().double(), dim=1).numpy()
    rest = gaussians.sh_rest.detach().cpu().double().numpy()
    degree = SH_COUNTS.index(rest.shape[1])
    scales = np.log(np.maximum(gaussians.scales.detach().cpu().double().numpy(), 1e-30))
    head = struct.pack("<IIIBBBB", MAGIC, VERSION, len(means), degree, bits, ANTIALIASED * antialiased, 0)
    bytes_ = (
        255.0 * gaussians.opacities.detach().cpu().double().numpy(),
        127.5 + 255.0 * COLOR_SCALE * gaussians.sh_dc.detach().cpu().double().numpy(),
        SCALE_STEPS * (scales + SCALE_OFFSET),
        128.0 + 128.0 * rest * FLIPS[: rest.shape[1], None],
    )
    opacity, color, scale, harmonics = (_byte(values) for values in bytes_)
    parts = (
        np.ascontiguousarray(fixed).view("u1").reshape(-1, 3, 4)[:, :, :3],
        opacity,
        color,
        scale,
        pack_quats(quats),
        harmonics,
    )
    content = gzip.compress(head + b"".join(part.tobytes() for part in parts), mtime=0)
    write_atomically(Path(path), content)
    return sum(int(((values < -0.5) | (values > 256.0)).sum()) for values in bytes_)


def _byte(values: np.ndarray) -> np.ndarray:
    return np.rint(values).clip(0, 255).astype("u1")


def pack_quats(quats: np.ndarray) -> np.ndarray:
    """Pack unit quaternions [N, 4] wxyz, in the frame of a ``.ply``, to [N] uint32: two bits name the largest of xyzw;
    ten bits (sign and nine of magnitude) hold each of the other three, divided by sqrt(1/2), in the order of xyzw."""
    turned = quats[:, [1, 2, 3, 0]] * (1, -1, -1, 1)
    largest = np.abs(turned).argmax(axis=1)
    turned = turned * np.where(np.take_along_axis(turned, largest[:, None], 1) < 0, -1.0, 1.0)
    packed = largest.astype(np.uint32)
    for k in range(4):
        size = np.minimum(np.floor(511.0 * np.abs(turned[:, k]) / SQRT_HALF + 0.5), 511).astype(np.uint32)
        code = (turned[:, k] < 0).astype(np.uint32) << np.uint32(9) | size
        packed = np.where(largest == k, packed, packed << np.uint32(10) | code)
    return packed.astype("<u4")


def unpack_quats(packed: np.ndarray) -> np.ndarray:
    """Unpack to [N, 4] wxyz float64 in the frame of a ``.ply``: the inverse of :func:`pack_quats`."""
    left = packed.astype(np.uint32).copy()
    largest = left >> np.uint32(30)
    quats = np.zeros((len(left), 4))
    for k in (3, 2, 1, 0):
        size = (left & np.uint32(511)).astype(np.float64) * (SQRT_HALF / 511.0)
        value = np.where(left >> np.uint32(9) & np.uint32(1), -size, size)
        quats[:, k] = np.where(largest == k, 0.0, value)
        left = np.where(largest == k, left, left >> np.uint32(10))
    remaining = np.sqrt(np.maximum(1.0 - (quats**2).sum(axis=1), 0.0))
    np.put_along_axis(quats, largest[:, None].astype(np.int64), remaining[:, None], 1)
    return (quats * (1, -1, -1, 1))[:, [3, 0, 1, 2]]


def _three_bytes(packed: np.ndarray) -> np.ndarray:
    """Unpack the rotations of version 2 to [N, 4] wxyz: x, y, z are bytes, and w completes the quaternion to unit
    length."""
    axis = packed.astype(np.float64) / 127.5 - 1.0
    w = np.sqrt(np.maximum(1.0 - (axis**2).sum(axis=1), 0.0))
    return np.column_stack([w, axis * (1, -1, -1)])


def read_spz(path: str | Path) -> GaussianParameters:
    """Read raw parameters in the frame of a ``.ply`` from versions 2 to 4.

    Raises:
        UserError: the file is missing, damaged or of another version, or it is of version 4 and the package zstandard
            is missing.
    """
    path = Path(path)
    content = read_bytes(path, "give a .spz")
    if content[:4] == struct.pack("<I", MAGIC):
        version, count, degree, bits, parts = _read_streams(path, content)
    else:
        version, count, degree, bits, parts = _read_gzip(path, content)
    fixed = np.zeros((count, 3, 4), "u1")
    fixed[:, :, 1:] = parts[0].reshape(count, 3, 3)
    means = (fixed.view("<i4")[:, :, 0] >> 8).astype(np.float32)  # The shift extends the sign; 24 bits are exact.
    means *= np.array([1, -1, -1], np.float32) * np.float32(2.0**-bits)
    opacity = np.linspace(0.0, 1.0, 256).clip(1e-6, 1.0 - 1e-6)  # The opacity of every byte.
    quats = _three_bytes(parts[4].reshape(count, 3)) if version == 2 else unpack_quats(parts[4].view("<u4"))
    rest = parts[5].reshape(count, SH_COUNTS[degree], 3).astype(np.float32)
    rest -= 128.0
    rest *= FLIPS[: SH_COUNTS[degree], None] / 128.0
    steps = np.arange(256)
    values = {
        "means": means,
        "sh_dc": ((steps / 255.0 - 0.5) / COLOR_SCALE).astype(np.float32)[parts[2].reshape(count, 3)],
        "sh_rest": rest,
        "opacity_logits": np.log(opacity / (1.0 - opacity)).astype(np.float32)[parts[1]],
        "log_scales": (steps / SCALE_STEPS - SCALE_OFFSET).astype(np.float32)[parts[3].reshape(count, 3)],
        "quats": quats.astype(np.float32),
    }
    return to_parameters(path, values)


def read_antialiased(path: str | Path) -> bool:
    """Return whether a ``.spz`` is marked as trained with the antialiasing compensation; return False for other
    files."""
    path = Path(path)
    if path.suffix.lower() != ".spz":
        return False
    try:
        with open(path, "rb") as file:
            start = file.read(4096)
        if start[:4] != struct.pack("<I", MAGIC):
            start = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(start, 16)
        return bool(start[14] & ANTIALIASED)
    except (OSError, zlib.error, IndexError):
        return False  # The reader of the Gaussians reports the damage.


def _sizes(path: Path, version: int, count: int, degree: int) -> list[int]:
    """Return the number of bytes of each array."""
    if not 2 <= version <= 4:
        raise UserError(f"{path}: version {version} of .spz; 2 to 4 are read: convert it, for example to .ply")
    if count == 0 or degree >= len(SH_COUNTS):
        raise UserError(f"{path}: {count} Gaussians with harmonics of degree {degree}; at least 1 of degree 0 to 3")
    if count > MAX_GAUSSIANS:
        raise UserError(
            f"{path}: says it holds {count:,} Gaussians; up to {MAX_GAUSSIANS:,} are read: {REMEDY} in parts"
        )
    return [9 * count, count, 3 * count, 3 * count, (3 if version == 2 else 4) * count, 3 * SH_COUNTS[degree] * count]


def _read_gzip(path: Path, content: bytes) -> tuple[int, int, int, int, list[np.ndarray]]:
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        head = stream.decompress(content, 16)
        magic, version, count, degree, bits = struct.unpack("<IIIBBxx", head)
    except (zlib.error, struct.error):
        raise UserError(f"{path}: neither a gzip stream nor a .spz of version 4; {REMEDY}") from None
    if magic != MAGIC:
        raise UserError(f"{path}: a gzip stream of something else than Gaussians; give a .spz")
    sizes = _sizes(path, version, count, degree)
    if sum(sizes) > MAX_GZIP_RATIO * len(content):
        raise UserError(f"{path}: cut short: {len(content):,} bytes cannot hold {count:,} Gaussians; {REMEDY}")
    try:
        rows = stream.decompress(stream.unconsumed_tail, sum(sizes))  # The size is bounded by the header.
    except zlib.error:
        rows = b""
    if len(rows) != sum(sizes):
        raise UserError(f"{path}: cut short or damaged; {REMEDY}")
    return version, count, degree, bits, np.split(np.frombuffer(rows, "u1"), np.cumsum(sizes)[:-1])


def _read_streams(path: Path, content: bytes) -> tuple[int, int, int, int, list[np.ndarray]]:
    """Read version 4: one stream for each non-empty array."""
    try:
        import zstandard
    except ImportError:
        raise UserError(
            f"{path}: .spz of version 4 needs the package zstandard: pip install -e '.[export]' in a clone"
        ) from None
    parts = []
    try:
        version, count, degree, bits, _, streams, table = struct.unpack_from("<4xIIBBBBI", content)
        sizes = _sizes(path, version, count, degree)
        offset, decoder = table + 16 * streams, zstandard.ZstdDecompressor()
        used = [size for size in sizes if size]
        if streams != len(used):
            raise ValueError
        for index, size in enumerate(used):
            packed, plain = struct.unpack_from("<QQ", content, table + 16 * index)
            if plain != size or offset + packed > len(content):
                raise ValueError
            # The size claimed by the zstd frame is not trusted: decoding is bounded by the header.
            with decoder.stream_reader(content[offset : offset + packed]) as reader:
                parts.append(np.frombuffer(reader.read(size), "u1"))
            if len(parts[-1]) != size:
                raise ValueError
            offset += packed
    except (struct.error, zstandard.ZstdError, ValueError, MemoryError, OverflowError):
        raise UserError(f"{path}: damaged; {REMEDY}") from None
    return version, count, degree, bits, [*parts, *[np.zeros(0, "u1")] * (len(sizes) - len(parts))]
