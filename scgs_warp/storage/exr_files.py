"""OpenEXR images of one number per pixel, such as depth."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError

MAGIC = b"\x76\x2f\x31\x01"
INSTALL = 'reading .exr needs OpenEXR; pip install "scgs-warp[exr]"'
REMEDY = "save the depth as the only channel, or as channel Z"
MOST_NUMBERS = 1 << 26
"""Largest number of pixels times channels, which bounds memory."""


def reads_exr() -> bool:
    """Return whether the optional package is there."""
    return importlib.util.find_spec("OpenEXR") is not None


def read_exr(path: Path) -> np.ndarray:
    """Read the depth of a file as [h, w], float16, float32 or uint32.

    Raises:
        UserError: OpenEXR is not installed, the file is missing or damaged, it is too large, or it has several channels
            none of which is known as depth.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    with open(path, "rb") as file:
        if file.read(4) != MAGIC:
            raise UserError(f"{path}: does not decode as OpenEXR; save it again")
    if not reads_exr():
        raise UserError(f"{path}: {INSTALL}")
    try:
        import OpenEXR

        with _silent():
            headers = [part.header for part in OpenEXR.File(str(path), header_only=True).parts]
        part, channel = _choose(path, headers)
        with _silent():
            pixels = OpenEXR.File(str(path), separate_channels=True).parts[part].channels[channel].pixels
    except (ImportError, AttributeError):
        raise UserError(f"{path}: {INSTALL} --upgrade") from None
    except (RuntimeError, ValueError, KeyError, IndexError, TypeError, OSError):
        raise UserError(f"{path}: does not decode as OpenEXR; save it again") from None
    if not isinstance(pixels, np.ndarray) or pixels.ndim != 2 or pixels.dtype.hasobject:
        raise UserError(f"{path}: does not decode as OpenEXR; save it again")
    return pixels


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep the library's own lines about damaged files, which come from C++, from the terminal."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _choose(path: Path, headers: list[dict[str, Any]]) -> tuple[int, str]:
    """Return the part that holds the depth, and its channel there: the only one, one called Z (of a layer, perhaps), or
    one with depth in its name."""
    found = [(part, channel.name) for part, header in enumerate(headers) for channel in header["channels"]]
    named = [place for place in found if place[1].split(".")[-1] == "Z"]
    named += [place for place in found if "depth" in place[1].lower()]
    if not named and len(found) != 1:
        raise UserError(f"{path}: has the channels {', '.join(name for _, name in found)}; {REMEDY}")
    place = (named or found)[0]
    numbers = 0
    for header in headers:
        low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
        numbers += int(np.prod(high - low + 1)) * len(header["channels"])
    if numbers > MOST_NUMBERS:
        raise UserError(f"{path}: has more than {MOST_NUMBERS:,} numbers; {REMEDY}")
    header = headers[place[0]]
    if any(not np.array_equal(a, b) for a, b in zip(header["dataWindow"], header["displayWindow"])):
        raise UserError(f"{path}: its data window is not its display window; save the whole picture")
    return place
