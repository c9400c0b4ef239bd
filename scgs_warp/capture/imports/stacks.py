"""Arrays of frames in ``.npz`` files, read frame by frame: without pickle, and never more than one frame in memory."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np

from ...errors import UserError
from ...storage.safe_paths import is_regular

MAX_FRAME_BYTES = 1 << 28
MAX_FRAMES = 20_000
SMALLEST = 8
"""Smallest side of an image, pixels."""
OVERSHOOT = 0.1
"""How far colours may leave [0, 1], as resampling makes them."""


class Stack:
    """An array [N, ...] in an ``.npz``, of numbers."""

    def __init__(self, path: Path, member: str) -> None:
        """
        Raises:
            UserError: the array is missing, damaged or too large.
        """
        self.path, self.member = path, member
        with self._opened() as (_, shape, kind, size):
            self.shape, self.kind = shape, kind
            if not shape or not 1 <= shape[0] <= MAX_FRAMES:
                raise UserError(f"{path}: {member} is {list(shape)}; it must hold 1 to {MAX_FRAMES} frames")
            self.frame_bytes = math.prod(shape[1:]) * kind.itemsize
            if self.frame_bytes > MAX_FRAME_BYTES or shape[0] * self.frame_bytes > size:
                raise UserError(f"{path}: {member} says it is {list(shape)}, which it does not hold; export it again")

    def frames(self) -> Iterator[np.ndarray]:
        """Yield the frames in order.

        Raises:
            UserError: the array is damaged.
        """
        with self._opened() as (file, _, _, _):
            for _ in range(self.shape[0]):
                data = file.read(self.frame_bytes)
                if len(data) != self.frame_bytes:
                    raise UserError(f"{self.path}: {self.member} ends early; export it again")
                yield np.frombuffer(data, self.kind).reshape(self.shape[1:])

    @contextmanager
    def _opened(self) -> Iterator[tuple[IO[bytes], tuple[int, ...], np.dtype, int]]:
        try:
            if not is_regular(self.path):
                raise UserError(f"{self.path}: not a file; give an .npz")
            with zipfile.ZipFile(self.path) as archive:
                info = archive.getinfo(f"{self.member}.npy")
                with archive.open(info) as file:
                    version = np.lib.format.read_magic(file)
                    if version == (1, 0):
                        shape, fortran, kind = np.lib.format.read_array_header_1_0(file)
                    elif version == (2, 0):
                        shape, fortran, kind = np.lib.format.read_array_header_2_0(file)
                    else:
                        raise ValueError("version")
                    if kind.kind not in "fiu" or (fortran and len(shape) > 1):
                        raise UserError(f"{self.path}: {self.member} holds no numbers in C order; export it again")
                    yield file, shape, kind, info.file_size
        except KeyError:
            raise UserError(f"{self.path}: holds no array named {self.member!r}; export it again") from None
        except FileNotFoundError:
            raise UserError(f"{self.path}: no such file; give an .npz") from None
        except OSError as error:
            raise UserError(f"{self.path}: cannot be read ({error.strerror or 'damaged'}); export it again") from None
        except UserError:
            raise
        except Exception as error:  # damaged headers and archives fail in many ways
            raise UserError(f"{self.path}: no sound .npz ({type(error).__name__}); export it again") from None


class InOrder:
    """Frames of a stack by their index; asked for in ascending order, each is read once."""

    def __init__(self, stack: Stack) -> None:
        self._stack = stack
        self._next = 0
        self._frames: Iterator[np.ndarray] | None = None
        self._last: np.ndarray | None = None

    def at(self, index: int) -> np.ndarray:
        """Return a frame."""
        if self._frames is None or index < self._next - 1:
            self._frames, self._next, self._last = self._stack.frames(), 0, None
        while self._next <= index:
            self._last = next(self._frames)
            self._next += 1
        assert self._last is not None
        return self._last


def members(path: Path) -> set[str]:
    """Return the names of the arrays in an ``.npz``; empty if the file is none."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {name[:-4] for name in archive.namelist() if name.endswith(".npy")}
    except Exception:  # whatever is wrong with the file, it holds no arrays
        return set()


def open_maps(path: Path, name: str, shape: tuple[int, int, int]) -> Stack:
    """Open an array [N, H, W], perhaps with a further axis of length 1."""
    stack = Stack(path, name)
    if tuple(side for side in stack.shape[1:] if side != 1) != shape[1:] or stack.shape[0] != shape[0]:
        raise UserError(
            f"{path}: {name} is {list(stack.shape)}, which does not fit {shape[0]} images of {shape[2]} x {shape[1]} "
            "pixels; export it again"
        )
    return stack


def image_size(images: Stack) -> tuple[int, int, bool]:
    """Return height, width, and whether the channels come first."""
    path, name, shape = images.path, images.member, images.shape
    if len(shape) == 4 and shape[3] == 3:
        height, width, first = shape[1], shape[2], False
    elif len(shape) == 4 and shape[1] == 3:
        height, width, first = shape[2], shape[3], True
    else:
        raise UserError(f"{path}: {name} is {list(shape)}, not [N, H, W, 3] or [N, 3, H, W]; export it again")
    if images.kind.kind != "f" and images.kind != np.uint8:
        raise UserError(f"{path}: {name} holds {images.kind}, not bytes or numbers in [0, 1]; export it again")
    if min(height, width) < SMALLEST:
        raise UserError(f"{path}: {name} are {width} x {height} pixels; export larger ones")
    return height, width, first


def picture(values: np.ndarray, channels_first: bool, place: str) -> np.ndarray:
    """Return a picture [H, W, 3] uint8 of bytes, or of numbers in [0, 1]; ``place`` names it in an error."""
    image = np.moveaxis(values, 0, 2) if channels_first else values
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    finite = np.nan_to_num(floats(image), nan=0.0, posinf=1.0, neginf=0.0)
    least, most = float(finite.min()), float(finite.max())
    if least < -OVERSHOOT or most > 1.0 + OVERSHOOT:
        raise UserError(f"{place} goes from {least:g} to {most:g}; export bytes, or numbers in [0, 1]")
    return np.ascontiguousarray(np.rint(finite.clip(0.0, 1.0) * 255.0).astype(np.uint8))


def floats(values: np.ndarray) -> np.ndarray:
    """Convert to float64."""
    with np.errstate(invalid="ignore"):  # signalling NaN would warn
        return values.astype(np.float64)
