"""Moving Gaussians as ``.4dgs``, the container of https://4dgs.dev (Avala AI, Apache-2.0), version 1.

The format has two temporal models, of which ``keyframe-delta`` is written: the whole state every ``KEYFRAME_EVERY``
steps, and between these only the Gaussians whose linear motion no longer holds. A reader finds any instant by the index
at the end.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .. import __version__
from ..errors import UserError
from ..geometry.morton import morton_order
from ..storage.files import write_atomically
from .segments import POSITION, Course, Segments, segments

MAGIC = b"\x894DGS1\r\n"
HEADER, FOOTER, QUANTIZATION, WINDOWS, CHUNK, BAND, INDEX, CAMERA, STATISTICS, DELTA = (
    0x01, 0x02, 0x03, 0x04, 0x05, 0x07, 0x08, 0x0A, 0x0C, 0x10,
)  # fmt: skip
ATTRIBUTES = {
    "position": 0, "scale": 1, "rotation_index": 2, "rotation": 3, "color": 4, "opacity": 5, "motion": 6, "mu_t": 7,
    "sigma_t": 8, "flags": 9, "window_index": 10, "id": 13,
}  # fmt: skip
CHANGING = ("position", "scale", "rotation_index", "rotation", "color", "motion", "mu_t")
ABSOLUTE = ("rotation_index", "rotation")
"""Attributes that an update states anew; of the others it holds the difference."""
KEYFRAME_EVERY = 32
RAW, DELTAS, CONSTANT = 0, 1, 2
CUTOFF = 0.05
COEFFICIENT = 4.0
"""Largest magnitude of a spherical harmonic."""
MAX_DEGREE = 3
LEVEL = 6
FARTHEST = 2**30
"""Largest position in steps."""


@dataclass(frozen=True)
class Grids:
    """Steps of the quantisation; a value is at most half a step off."""

    origin: np.ndarray
    """[3] float64."""
    position: float
    motion: float
    """Step of velocities, for these Gaussians."""
    motion_reference: float
    """The same for a lifetime of half a second, which the file states."""
    time: float
    scale: float = 0.02
    rotation: float = 2.0 / 1023.0
    color: float = 1.0 / 255.0
    alpha: float = 1.0 / 255.0


class StillPart(NamedTuple):
    """What does not change over time."""

    opacities: np.ndarray
    """[N]"""
    harmonics: list[np.ndarray]
    """[N, K - 1, 3] at each keyframe."""


class View(NamedTuple):
    """Suggested view, OpenCV's or any other handedness alike: two points and an angle."""

    fov_y: float
    """Degrees."""
    position: tuple[float, float, float]
    target: tuple[float, float, float]


@dataclass
class _Writer:
    """File under construction."""

    parts: list[bytes] = field(default_factory=list)
    size: int = 0
    index: list[bytes] = field(default_factory=list)

    def add(self, content: bytes) -> tuple[int, int]:
        """Append bytes; return their offset and length."""
        self.parts.append(content)
        offset, self.size = self.size, self.size + len(content)
        return offset, len(content)


def write_fourdgs(
    path: Path,
    course: Course,
    still: StillPart,
    *,
    up: tuple[float, float, float],
    view: View,
    advance: Callable[[], None] | None = None,
) -> int:
    """Write moving Gaussians; the same ones give the same bytes.

    Args:
        course: at least two moments, evenly spaced from 0 on.
        up: unit vector.
        advance: called after each moment but the last.

    Returns:
        Number of segments.

    Raises:
        UserError: a Gaussian is too far away for the format, or the file cannot be written.
    """
    order = morton_order(course.means[0])  # neighbours together: deflate compresses them better
    course = course._replace(
        **{name: getattr(course, name)[:, order] for name in ("means", "quats", "scales", "colors")}
    )
    still = StillPart(still.opacities[order], [values[order] for values in still.harmonics])
    grids = _grids(course)
    writer, count = _Writer(), len(order)
    writer.add(MAGIC + _front(course, still, grids, up) + _camera(view))
    state: dict[str, np.ndarray] = {}
    reference = keyframe = depth = total = 0
    for piece in segments(course, KEYFRAME_EVERY):
        bins = _bins(piece, course.seconds, grids)
        total += len(piece.rows)
        span = struct.pack("<2d", course.seconds[piece.frame], course.seconds[piece.frame + 1])
        bands: list[bytes] = []
        if piece.frame % KEYFRAME_EVERY == 0:
            state, depth = bins, 0
            place = writer.add(_record(CHUNK, span + _state_chunk(bins, still.opacities, grids)))
            keyframe = place[0]
            for band, codes in enumerate(_harmonics(still.harmonics[piece.frame // KEYFRAME_EVERY]), 1):
                where = writer.add(_record(BAND, struct.pack("<B", band) + _stream(BAND, codes)))
                bands.append(struct.pack("<B2Q", band, *where))
            kind, mode, before = 0, 0, 0
        else:
            depth, kind, mode, before = depth + 1, 1, 1, reference
            head = struct.pack("<IB2QH3I", 0, mode, reference, keyframe, depth, len(piece.rows), 0, 0)
            place = writer.add(_record(DELTA, span + head + _updates(piece.rows, bins, state)))
        reference = place[0]
        entry = span + struct.pack("<2Q2I", *place, len(piece.rows), len(bands)) + b"".join(bands)
        writer.index.append(_record(INDEX, entry + struct.pack("<2B2QHQ", kind, mode, before, keyframe, depth, count)))
        if advance is not None:
            advance()
    statistics = struct.pack("<QId6d", count, len(writer.index), course.seconds[-1], *_box(course))
    summary = b"".join(writer.index) + _record(STATISTICS, statistics)
    start, _ = writer.add(summary)
    writer.add(_record(FOOTER, struct.pack("<2QI", start, 0, zlib.crc32(summary))) + MAGIC)
    write_atomically(path, b"".join(writer.parts))
    return total


def _grids(course: Course) -> Grids:
    """Choose the steps. Those of velocities follow from the format: finer for longer lives, in powers of two, such that
    a Gaussian is at most half a step of positions off at the end of its life."""
    step = POSITION * course.extent / 2.0
    origin = course.means.min(axis=(0, 1)).astype(np.float64)
    if np.ptp(course.means, axis=(0, 1)).max() / step > FARTHEST:
        raise UserError(
            "--format 4dgs: a Gaussian is too far away for the format; move it less far if an edit put it there, or "
            "train with --set densify.prune_large=on"
        )
    life = min(max(float(course.seconds[-1]), 0.02), 2.0)
    finer = min(max(int(np.ceil(np.log2(life / 0.5))), -4), 2)
    motion = 2.0 * step / 0.5
    return Grids(origin, step, motion * 2.0**-finer, motion, float(course.seconds[1]) / 64.0)


def _box(course: Course) -> list[float]:
    low, high = course.means.min(axis=(0, 1)), course.means.max(axis=(0, 1))
    return [*low.astype(float).tolist(), *high.astype(float).tolist()]


def _front(course: Course, still: StillPart, grids: Grids, up: tuple[float, float, float]) -> bytes:
    """Return the records before the chunks: header, quantisation, the one validity window."""
    degree = min(round((still.harmonics[0].shape[1] + 1) ** 0.5) - 1, MAX_DEGREE)
    seconds = float(course.seconds[-1])
    about = {
        "coordinate_system": f"right-handed; up is {', '.join(f'{value:.6g}' for value in up)}",
        "keyframe_interval_sec": f"{KEYFRAME_EVERY * float(course.seconds[1]):.9g}",
        "gop_max_depth": str(min(KEYFRAME_EVERY, len(course.seconds) - 1) - 1),
    }
    header = _text("keyframed") + _text(f"scgs_warp {__version__}")
    header += struct.pack("<dQd", seconds, len(still.opacities), CUTOFF) + _text("keyframe-delta")
    header += struct.pack("<6d2B", *_box(course), degree, 0) + _map(about)
    steps = grids.position, grids.scale, grids.rotation, grids.color, grids.alpha, grids.motion_reference, grids.time
    bounds = {
        "pos": grids.position / 2, "scale_rel": float(np.expm1(grids.scale / 2)), "rot": grids.rotation / 2,
        "rgb": grids.color / 2, "alpha": grids.alpha / 2, "motion": grids.motion_reference / 2, "time": grids.time / 2,
        "sigma_rel": 0.01, "sh": 0,
    }  # fmt: skip
    quantization = _text("uniform-v1") + struct.pack("<3d8dB", *grids.origin, *steps, 0.02, 1)
    quantization += _map({name: repr(value) for name, value in bounds.items()})
    window = struct.pack("<I2d", 1, 0.0, seconds)
    return _record(HEADER, header) + _record(QUANTIZATION, quantization) + _record(WINDOWS, window)


def _camera(view: View) -> bytes:
    fields = struct.pack("<7dI", view.fov_y, *view.position, *view.target, 0)
    return _record(CAMERA, fields + _text("linear") + b"\0")


def _bins(piece: Segments, seconds: np.ndarray, grids: Grids) -> dict[str, np.ndarray]:
    """Quantise segments: whole numbers [R, C] by the name of the attribute."""
    largest, others = _smallest_three(piece.quats)
    red, green, blue = np.rint(piece.colors.clip(0.0, 1.0) / grids.color).astype(np.int64).T
    time = round(float(seconds[piece.frame]) / grids.time)
    return {
        "position": np.rint((piece.starts - grids.origin) / grids.position).astype(np.int64),
        "scale": np.rint(np.log(piece.scales) / grids.scale).astype(np.int64),
        "rotation_index": largest[:, None],
        "rotation": np.rint(others / grids.rotation).astype(np.int64),
        "color": np.stack([green, red - green, blue - green], 1),
        "motion": np.rint(piece.velocities / grids.motion).astype(np.int64),
        "mu_t": np.full((len(piece.rows), 1), time),
    }


def _smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index (xyzw) of the largest component [R], which is made positive, and the other three [R, 3]."""
    turned = (quats / np.linalg.norm(quats, axis=1, keepdims=True))[:, [1, 2, 3, 0]]
    largest = np.abs(turned).argmax(axis=1)
    rows = np.arange(len(turned))
    turned = np.where(turned[rows, largest] < 0, -1.0, 1.0)[:, None] * turned
    kept = np.arange(4)[None] != largest[:, None]
    return largest, turned[kept].reshape(-1, 3)


def _state_chunk(bins: dict[str, np.ndarray], opacities: np.ndarray, grids: Grids) -> bytes:
    """Return a chunk's content after its interval: all attributes of all Gaussians."""
    count = len(opacities)
    whole = {
        **bins,
        "opacity": np.rint(opacities.clip(0.0, 1.0) / grids.alpha).astype(np.int64)[:, None],
        "sigma_t": np.zeros((count, 1), np.int64),
        "flags": np.ones((count, 1), np.int64),  # never fades
        "window_index": np.zeros((count, 1), np.int64),
        "id": np.arange(count)[:, None],
    }
    streams = b"".join(_stream(ATTRIBUTES[name], values) for name, values in whole.items())
    return struct.pack("<2I", 0, count) + _text("") + struct.pack("<2Q", len(streams), len(streams)) + streams


def _updates(rows: np.ndarray, bins: dict[str, np.ndarray], state: dict[str, np.ndarray]) -> bytes:
    """Return a delta chunk's content after its head, and bring ``state`` up to date."""
    streams = b""
    if len(rows):
        streams = _stream(ATTRIBUTES["id"], rows[:, None])
        for name in CHANGING:
            values = bins[name] if name in ABSOLUTE else bins[name] - state[name][rows]
            if name in ABSOLUTE or values.any():
                streams += _stream(ATTRIBUTES[name], values)
            state[name][rows] = bins[name]
    groups = struct.pack("<Q", len(streams)) + streams + struct.pack("<2Q", 0, 0)
    return _text("") + struct.pack("<2Q", len(groups), len(groups)) + groups


def _harmonics(values: np.ndarray) -> list[np.ndarray]:
    """Return the codes of each band, [N, 3 (2 b + 1)]: all coefficients of red, then of green, then of blue."""
    codes = np.rint((values.clip(-COEFFICIENT, COEFFICIENT) + COEFFICIENT) * 255.0 / (2.0 * COEFFICIENT)).astype(
        np.int64
    )
    found = []
    for band in range(1, MAX_DEGREE + 1):
        if values.shape[1] >= (band + 1) ** 2 - 1:
            coefficients = codes[:, band**2 - 1 : (band + 1) ** 2 - 1]
            found.append(coefficients.transpose(0, 2, 1).reshape(len(values), -1))
    return found


def _stream(attribute: int, values: np.ndarray) -> bytes:
    """Return an attribute stream of whole numbers [R, C], R > 0, by the mode that takes least."""
    count, channels = values.shape
    if (values == values[0]).all():
        modes = [(CONSTANT, values[:1])]
    else:
        modes = [(RAW, values), (DELTAS, np.diff(values, axis=0, prepend=np.zeros((1, channels), np.int64)))]
    packed = []
    for mode, numbers in modes:
        symbols = ((numbers << 1) ^ (numbers >> 63)).astype(np.uint64).reshape(-1)  # signs in the lowest bit
        width = next(width for width in (1, 2, 4) if int(symbols.max()) < 1 << (8 * width))
        planes = symbols.astype(f"<u{width}").view(np.uint8).reshape(-1, width).T
        packed.append((mode, width, zlib.compress(planes.tobytes(), LEVEL)))
    mode, width, payload = min(packed, key=lambda item: len(item[2]))
    return struct.pack("<5BIQ", attribute, width, mode, 0, channels, count, len(payload)) + payload


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(value: str) -> bytes:
    content = value.encode()
    return struct.pack("<I", len(content)) + content


def _map(values: dict[str, str]) -> bytes:
    content = b"".join(_text(name) + _text(value) for name, value in sorted(values.items()))
    return struct.pack("<I", len(content)) + content
