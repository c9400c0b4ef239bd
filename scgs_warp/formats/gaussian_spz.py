"""``.spz`` (Niantic): Gaussians in some 20 to 64 bytes before compression.

A header of 16 bytes, then one array after the other: positions (24-bit fixed point), opacities, colours of degree 0,
logarithms of scales (a byte each), rotations, harmonics (coefficient by coefficient, channels innermost); all of it is
one gzip stream (versions 1 to 3), or a plain header of 32 bytes, a table and one zstd stream an array (version 4).
Positions are in a frame with x right, y up, z back, where a ``.ply`` has x right, y down, z forward.
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
"""What is written: the last one that a plain gzip reader opens, the first with four bytes a rotation."""
ANTIALIASED = 1
COLOR = 0.15
"""A byte of colour says ``127.5 + 255 * COLOR * sh_dc``."""
SCALE_STEPS, SCALE_LEAST = 16.0, 10.0
"""A byte of scale says ``SCALE_STEPS * (log(scale) + SCALE_LEAST)``: steps of 6 %, from 4.5e-5 to 377."""
FINE = 16
"""Positions are rounded to the size of the scene over 2 to this."""
LARGEST_SHIFT = 24
MOST = 10_000_000
"""Gaussians in a file, as the format's own reader has it."""
COUNTS = (0, 3, 8, 15)
"""Coefficients above degree 0, for degrees 0 to 3."""
FLIPS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""What a half turn about x does to each harmonic of degrees 1 to 3."""
HALF = math.sqrt(0.5)
DENSEST = 1040
"""Bytes that one byte of a gzip stream can stand for, and a little more."""
REMEDY = "export the .spz again"


def fraction_bits(means: np.ndarray) -> int:
    """Binary places for positions [N, 3]: as fine as makes sense, as coarse as 24 bits demand.

    Raises:
        UserError: a position is beyond 2^23.
    """
    middle = np.median(means, axis=0)
    extent = float(np.quantile(np.abs(means - middle).max(axis=1), 0.95)) or 1.0
    wanted = FINE - math.floor(math.log2(extent))
    reach = float(np.abs(means).max()) or 1.0
    room = math.floor(math.log2((2**23 - 1) / reach))
    if room < 0:
        raise UserError(f"a Gaussian lies {reach:.3g} from the origin; .spz holds up to 8.3e6: make the scene smaller")
    return max(0, min(wanted, room, LARGEST_SHIFT))


def write_spz(path: str | Path, gaussians: Gaussians, *, antialiased: bool = False) -> int:
    """Write activated Gaussians, world units, as version 3.

    Rounded: positions to ``2 ** -fraction_bits``, opacities and colours to 8 bits, scales to 6 %, rotations to 10 bits
    a component, harmonics to 1 / 128 within [-1, 1].

    Args:
        antialiased: whether they were trained with the antialiasing compensation.

    Returns:
        How many values lay beyond what a byte can say, and are at its end now: scales outside [4.5e-5, 377], harmonics
        of degrees 1 to 3 outside [-1, 1], those of degree 0 outside [-3.3, 3.3].

    Raises:
        UserError: the place cannot be written, or the scene is too large for the format.
    """
    means = gaussians.means.detach().cpu().double().numpy() * (1, -1, -1)
    bits = fraction_bits(means)
    fixed = np.rint(means * 2.0**bits).astype("<i4")
    quats = torch.nn.functional.normalize(gaussians.quats.detach().cpu().double(), dim=1).numpy()
    rest = gaussians.sh_rest.detach().cpu().double().numpy()
    degree = COUNTS.index(rest.shape[1])
    scales = np.log(np.maximum(gaussians.scales.detach().cpu().double().numpy(), 1e-30))
    head = struct.pack("<IIIBBBB", MAGIC, VERSION, len(means), degree, bits, ANTIALIASED * antialiased, 0)
    bytes_ = (
        255.0 * gaussians.opacities.detach().cpu().double().numpy(),
        127.5 + 255.0 * COLOR * gaussians.sh_dc.detach().cpu().double().numpy(),
        SCALE_STEPS * (scales + SCALE_LEAST),
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
    """[N] uint32 of unit quaternions [N, 4] wxyz in a ``.ply``'s frame: two bits say which of xyzw is the largest, ten
    bits (sign, nine of magnitude) hold each of the others over sqrt(1/2), in the order of xyzw."""
    turned = quats[:, [1, 2, 3, 0]] * (1, -1, -1, 1)
    largest = np.abs(turned).argmax(axis=1)
    turned = turned * np.where(np.take_along_axis(turned, largest[:, None], 1) < 0, -1.0, 1.0)
    packed = largest.astype(np.uint32)
    for k in range(4):
        size = np.minimum(np.floor(511.0 * np.abs(turned[:, k]) / HALF + 0.5), 511).astype(np.uint32)
        code = (turned[:, k] < 0).astype(np.uint32) << np.uint32(9) | size
        packed = np.where(largest == k, packed, packed << np.uint32(10) | code)
    return packed.astype("<u4")


def unpack_quats(packed: np.ndarray) -> np.ndarray:
    """[N, 4] wxyz float64, in a ``.ply``'s frame: the inverse of :func:`pack_quats`."""
    left = packed.astype(np.uint32).copy()
    largest = left >> np.uint32(30)
    found = np.zeros((len(left), 4))
    for k in (3, 2, 1, 0):
        size = (left & np.uint32(511)).astype(np.float64) * (HALF / 511.0)
        value = np.where(left >> np.uint32(9) & np.uint32(1), -size, size)
        found[:, k] = np.where(largest == k, 0.0, value)
        left = np.where(largest == k, left, left >> np.uint32(10))
    remaining = np.sqrt(np.maximum(1.0 - (found**2).sum(axis=1), 0.0))
    np.put_along_axis(found, largest[:, None].astype(np.int64), remaining[:, None], 1)
    return (found * (1, -1, -1, 1))[:, [3, 0, 1, 2]]


def _three_bytes(packed: np.ndarray) -> np.ndarray:
    """[N, 4] wxyz of version 2: x, y, z as bytes, w what is left."""
    axis = packed.astype(np.float64) / 127.5 - 1.0
    w = np.sqrt(np.maximum(1.0 - (axis**2).sum(axis=1), 0.0))
    return np.column_stack([w, axis * (1, -1, -1)])


def read_spz(path: str | Path) -> GaussianParameters:
    """Raw parameters, in a ``.ply``'s frame. Versions 2 to 4.

    Raises:
        UserError: it is missing, damaged, of another version, or version 4 without the package zstandard.
    """
    path = Path(path)
    content = read_bytes(path, "give a .spz")
    if content[:4] == struct.pack("<I", MAGIC):
        version, count, degree, bits, parts = _read_streams(path, content)
    else:
        version, count, degree, bits, parts = _read_gzip(path, content)
    fixed = np.zeros((count, 3, 4), "u1")
    fixed[:, :, 1:] = parts[0].reshape(count, 3, 3)
    means = (fixed.view("<i4")[:, :, 0] >> 8).astype(np.float32)  # shifted down again with the sign; 24 bits are exact
    means *= np.array([1, -1, -1], np.float32) * np.float32(2.0**-bits)
    opacity = np.linspace(0.0, 1.0, 256).clip(1e-6, 1.0 - 1e-6)  # of every byte
    quats = _three_bytes(parts[4].reshape(count, 3)) if version == 2 else unpack_quats(parts[4].view("<u4"))
    rest = parts[5].reshape(count, COUNTS[degree], 3).astype(np.float32)
    rest -= 128.0
    rest *= FLIPS[: COUNTS[degree], None] / 128.0
    steps = np.arange(256)
    values = {
        "means": means,
        "sh_dc": ((steps / 255.0 - 0.5) / COLOR).astype(np.float32)[parts[2].reshape(count, 3)],
        "sh_rest": rest,
        "opacity_logits": np.log(opacity / (1.0 - opacity)).astype(np.float32)[parts[1]],
        "log_scales": (steps / SCALE_STEPS - SCALE_LEAST).astype(np.float32)[parts[3].reshape(count, 3)],
        "quats": quats.astype(np.float32),
    }
    return to_parameters(path, values)


def read_antialiased(path: str | Path) -> bool:
    """Whether a file says that its Gaussians were trained with the antialiasing compensation; only a ``.spz`` can."""
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
        return False  # whoever reads the Gaussians says what is wrong


def _sizes(path: Path, version: int, count: int, degree: int) -> list[int]:
    """Bytes of each array."""
    if not 2 <= version <= 4:
        raise UserError(f"{path}: version {version} of .spz; 2 to 4 are read: convert it, for example to .ply")
    if count == 0 or degree >= len(COUNTS):
        raise UserError(f"{path}: {count} Gaussians with harmonics of degree {degree}; at least 1 of degree 0 to 3")
    if count > MOST:
        raise UserError(f"{path}: says it holds {count:,} Gaussians; up to {MOST:,} are read: {REMEDY} in parts")
    return [9 * count, count, 3 * count, 3 * count, (3 if version == 2 else 4) * count, 3 * COUNTS[degree] * count]


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
    if sum(sizes) > DENSEST * len(content):
        raise UserError(f"{path}: cut short: {len(content):,} bytes cannot hold {count:,} Gaussians; {REMEDY}")
    try:
        rows = stream.decompress(stream.unconsumed_tail, sum(sizes))  # never more than the header promises
    except zlib.error:
        rows = b""
    if len(rows) != sum(sizes):
        raise UserError(f"{path}: cut short or damaged; {REMEDY}")
    return version, count, degree, bits, np.split(np.frombuffer(rows, "u1"), np.cumsum(sizes)[:-1])


def _read_streams(path: Path, content: bytes) -> tuple[int, int, int, int, list[np.ndarray]]:
    """Version 4: a stream for each array that is not empty."""
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
        place, decoder = table + 16 * streams, zstandard.ZstdDecompressor()
        used = [size for size in sizes if size]
        if streams != len(used):
            raise ValueError
        for index, size in enumerate(used):
            packed, plain = struct.unpack_from("<QQ", content, table + 16 * index)
            if plain != size or place + packed > len(content):
                raise ValueError
            # The frame's own claim is not trusted: no more than the header promises is decoded.
            with decoder.stream_reader(content[place : place + packed]) as reader:
                parts.append(np.frombuffer(reader.read(size), "u1"))
            if len(parts[-1]) != size:
                raise ValueError
            place += packed
    except (struct.error, zstandard.ZstdError, ValueError, MemoryError, OverflowError):
        raise UserError(f"{path}: damaged; {REMEDY}") from None
    return version, count, degree, bits, [*parts, *[np.zeros(0, "u1")] * (len(sizes) - len(parts))]
