"""``.spz`` files (Niantic): Gaussians of 20 to 64 bytes before compression.

Arrays of positions (24-bit fixed point), opacities, colours of degree 0, logarithms of scales (a byte each), rotations
and harmonics (coefficient by coefficient, channels innermost) are in a container (:mod:`.spz_container`).
Positions are in a frame with x right, y up, z back, unless an extension names another; a ``.ply`` has x right, y down,
z forward.
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from ..errors import UserError
from ..gaussians import GaussianParameters
from ..storage.files import open_regular, read_bytes, write_atomically
from ..types import Gaussians
from .gaussian_parameters import to_parameters
from .spz_axes import NAMES, STANDARD, turn_axes
from .spz_container import ANTIALIASED, MAGIC, REMEDY, SH_COUNTS, SpzHead, pack_gzip, pack_streams, unpack

VERSION = 4
"""Version that is written unless another is asked for: the only one that PlayCanvas reads."""
COLOR_SCALE = 0.15
"""Factor on coefficients of degree 0: a byte of colour is ``127.5 + 255 * COLOR_SCALE * sh_dc``."""
SCALE_STEPS, SCALE_OFFSET = 16.0, 10.0
"""Parameters of the logarithmic encoding: a byte of scale is ``SCALE_STEPS * (log(scale) + SCALE_OFFSET)``, in steps of
6 %, from 4.5e-5 to 377."""
POSITION_BITS = 16
"""Resolution of positions: they are rounded to (size of the scene) / ``2 ** POSITION_BITS``."""
COARSE_BITS = 11
"""Resolution below which rounding shows: half a pixel where the scene is 2,000 pixels wide."""
MAX_FRACTION_BITS = 24
READ_COUNT = 15
"""Number of coefficients that are read: those of degrees 1 to 3."""
FLIPS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""Signs by which a half turn about x multiplies the harmonics of degrees 1 to 3."""
SQRT_HALF = math.sqrt(0.5)


def fraction_bits(means: np.ndarray) -> int:
    """Choose the number of fractional bits for positions [N, 3], limited by the range of 24 bits.

    Raises:
        UserError: a position is beyond 2^23.
    """
    wanted = POSITION_BITS - math.floor(math.log2(_reach(means)))
    reach = float(np.abs(means).max()) or 1.0
    room = math.floor(math.log2((2**23 - 1) / reach))
    if room < 0:
        raise UserError(f"a Gaussian lies {reach:.3g} from the origin, and .spz holds up to 8.3e6; write a .ply")
    return max(0, min(wanted, room, MAX_FRACTION_BITS))


def _reach(means: np.ndarray) -> float:
    """Return the distance from their middle within which 95 % of positions [N, 3] lie along each axis."""
    return float(np.quantile(np.abs(means - np.median(means, axis=0)).max(axis=1), 0.95)) or 1.0


def coarse_step(means: np.ndarray) -> float | None:
    """Return the step to which positions [N, 3] are rounded, if so few steps span the scene that pictures show it: a
    scene that is very small or far from the origin, or that has Gaussians far from the others. Otherwise None."""
    step = 2.0 ** -fraction_bits(means)
    return step if _reach(means) < step * 2**COARSE_BITS else None


def check_positions(path: str | Path, means: np.ndarray) -> int:
    """Return the fractional bits of positions [N, 3] that are to be written.

    Raises:
        UserError: as ``fraction_bits``, and names the file.
    """
    try:
        return fraction_bits(means)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def write_spz(
    path: str | Path, gaussians: Gaussians, *, antialiased: bool = False, version: Literal[3, 4] = VERSION
) -> int:
    """Write activated Gaussians, world units.

    Values are rounded: positions to ``2 ** -fraction_bits``, opacities and colours to 8 bits, scales to 6 %, rotations
    to 10 bits a component, harmonics to 1 / 128 within [-1, 1]. Sharp Gaussians are approximated (``Gaussians.plain``).

    Args:
        antialiased: whether the Gaussians were trained with the antialiasing compensation.
        version: 4, or 3 for older readers: the same values in one gzip stream.

    Returns:
        Number of values that were clipped to the range of a byte: scales outside [4.5e-5, 377], harmonics of degrees 1
        to 3 outside [-1, 1], harmonics of degree 0 outside [-3.3, 3.3].

    Raises:
        UserError: the file cannot be written, the scene is too large for the format, or version 4 lacks the package
            zstandard.
    """
    gaussians = gaussians.plain()
    means = gaussians.means.detach().cpu().double().numpy() * (1, -1, -1)
    bits = check_positions(path, means)
    fixed = np.rint(means * 2.0**bits).astype("<i4")
    quats = torch.nn.functional.normalize(gaussians.quats.detach().cpu().double(), dim=1).numpy()
    rest = gaussians.sh_rest.detach().cpu().double().numpy()
    degree = SH_COUNTS.index(rest.shape[1])
    scales = np.log(np.maximum(gaussians.scales.detach().cpu().double().numpy(), 1e-30))
    head = SpzHead(version, len(means), degree, bits, ANTIALIASED * antialiased)
    bytes_ = (
        255.0 * gaussians.opacities.detach().cpu().double().numpy(),
        127.5 + 255.0 * COLOR_SCALE * gaussians.sh_dc.detach().cpu().double().numpy(),
        SCALE_STEPS * (scales + SCALE_OFFSET),
        128.0 + 128.0 * rest * FLIPS[: rest.shape[1], None],
    )
    opacity, color, scale, harmonics = (_byte(values) for values in bytes_)
    parts = [
        np.ascontiguousarray(fixed).view("u1").reshape(-1, 3, 4)[:, :, :3],
        opacity,
        color,
        scale,
        pack_quats(quats),
        harmonics,
    ]
    path = Path(path)
    write_atomically(path, pack_gzip(head, parts) if version == 3 else pack_streams(path, head, parts))
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
    """Unpack the rotations of versions 1 and 2 to [N, 4] wxyz: x, y, z are bytes, and w completes the quaternion to
    unit length."""
    axis = packed.astype(np.float64) / 127.5 - 1.0
    w = np.sqrt(np.maximum(1.0 - (axis**2).sum(axis=1), 0.0))
    return np.column_stack([w, axis * (1, -1, -1)])


def _places(head: SpzHead, part: np.ndarray) -> np.ndarray:
    """Unpack positions to [N, 3] float32 in the frame of a ``.ply``: half floats in version 1, else 24-bit numbers."""
    signs = np.array([1, -1, -1], np.float32)
    if head.version == 1:
        with np.errstate(invalid="ignore"):  # Signalling NaN would warn; such Gaussians are left out.
            return part.view("<f2").reshape(head.count, 3).astype(np.float32) * signs
    fixed = np.zeros((head.count, 3, 4), "u1")
    fixed[:, :, 1:] = part.reshape(head.count, 3, 3)
    means = (fixed.view("<i4")[:, :, 0] >> 8).astype(np.float32)  # The shift extends the sign; 24 bits are exact.
    means *= signs * np.float32(2.0**-head.bits)
    return means


def read_spz(path: str | Path) -> GaussianParameters:
    """Read raw parameters in the frame of a ``.ply`` from versions 1 to 4. Harmonics of degree 4 are left out.

    Raises:
        UserError: the file is missing, damaged or of another version, or it is of version 4 and the package zstandard
            is missing.
    """
    path = Path(path)
    head, parts = unpack(path, read_bytes(path, "give a .spz"))
    axes = head.axes()
    if axes is not None and axes > len(NAMES):
        raise UserError(f"{path}: its positions have axes number {axes}, which is none of 1 to {len(NAMES)}; {REMEDY}")
    count, rest_count = head.count, min(SH_COUNTS[head.degree], READ_COUNT)
    opacity = np.linspace(0.0, 1.0, 256).clip(1e-6, 1.0 - 1e-6)  # The opacity of every byte.
    quats = _three_bytes(parts[4].reshape(count, 3)) if head.version < 3 else unpack_quats(parts[4].view("<u4"))
    rest = parts[5].reshape(count, SH_COUNTS[head.degree], 3)[:, :rest_count].astype(np.float32)
    rest -= 128.0
    rest *= FLIPS[:rest_count, None] / 128.0
    steps = np.arange(256)
    values = {
        "means": _places(head, parts[0]),
        "sh_dc": ((steps / 255.0 - 0.5) / COLOR_SCALE).astype(np.float32)[parts[2].reshape(count, 3)],
        "sh_rest": rest,
        "opacity_logits": np.log(opacity / (1.0 - opacity)).astype(np.float32)[parts[1]],
        "log_scales": (steps / SCALE_STEPS - SCALE_OFFSET).astype(np.float32)[parts[3].reshape(count, 3)],
        "quats": quats.astype(np.float32),
    }
    if axes and NAMES[axes - 1] != STANDARD:
        turn_axes(values, NAMES[axes - 1])
    return to_parameters(path, values)


def read_antialiased_flag(path: Path) -> bool:
    """Return whether a ``.spz`` is marked as trained with the antialiasing compensation; False if it is damaged."""
    try:
        with open_regular(path) as file:
            start = file.read(4096)
        if start[:4] != struct.pack("<I", MAGIC):
            start = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(start, 16)
        return bool(start[14] & ANTIALIASED)
    except (OSError, zlib.error, IndexError):
        return False  # The reader of the Gaussians reports the damage.
