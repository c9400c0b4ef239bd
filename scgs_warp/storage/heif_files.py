"""Photographs in HEIF (``.heic``), which phones take and OpenCV does not read."""

from __future__ import annotations

import functools
import importlib.util
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from .files import open_regular

SUFFIXES = (".heic", ".heif", ".hif")
COMMAND = 'pip install "scgs-warp[heic]"'
INSTALL = f"reading HEIC needs pillow-heif; {COMMAND}"


def reads_heif() -> bool:
    """Return whether the optional package is there."""
    return importlib.util.find_spec("pillow_heif") is not None


def is_heif(path: Path) -> bool:
    """Return whether a file has a name that :func:`read_heif` reads."""
    return path.suffix.lower() in SUFFIXES


@functools.cache
def _register() -> None:
    import pillow_heif

    pillow_heif.register_heif_opener(thumbnails=False, depth_images=False, aux_images=False)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a photograph by Pillow.

    Raises:
        UserError: pillow-heif is not installed, or the file cannot be read or does not decode.
    """
    from PIL import Image

    if not reads_heif():
        raise UserError(f"{path}: {INSTALL}")
    _register()
    try:
        with open_regular(path) as file, Image.open(file) as image:
            yield image
    except (ValueError, SyntaxError, TypeError, KeyError, RuntimeError, EOFError, struct.error):
        raise UserError(f"{path}: is not a photograph that decodes; save it as JPEG, or take it out") from None
    except Image.DecompressionBombError:
        raise UserError(f"{path}: has too many pixels; save it again, smaller") from None
    except OSError as error:
        reason = error.strerror or "it does not decode"
        raise UserError(f"{path}: cannot be read ({reason}); save it as JPEG, or take it out") from None


def read_heif(path: Path) -> np.ndarray:
    """Read [H, W, 3] or, if the photograph has alpha, [H, W, 4] uint8, RGB, upright.

    Raises:
        UserError: as for :func:`heif_size`.
    """
    with _opened(path) as image:
        return np.array(image.convert("RGBA" if "A" in image.mode else "RGB"))


def heif_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of the upright photograph, from its header.

    Raises:
        UserError: pillow-heif is not installed, or the file cannot be read or does not decode.
    """
    with _opened(path) as image:
        return image.size


def heif_orientation(path: Path) -> int:
    """Return the EXIF orientation of the photograph as it is stored, 1 to 8.

    Raises:
        UserError: as for :func:`heif_size`.
    """
    with _opened(path) as image:
        return image.info.get("original_orientation") or 1
