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


def members(path: Path) -> set[str]:
    """Return the names of the arrays in an ``.npz``; empty if the file is none."""
    try:
        with zipfile.ZipFile(path) as archive:
            return {name[:-4] for name in archive.namelist() if name.endswith(".npy")}
    except Exception:  # whatever is wrong with the file, it holds no arrays
        return set()
