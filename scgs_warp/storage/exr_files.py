"""OpenEXR images of one number per pixel, such as depth."""

from __future__ import annotations

import contextlib
import importlib.util
import io
from pathlib import Path

import numpy as np

from ..errors import UserError

CHANNELS = ("Z", "depth.Z", "V", "depth.V", "Y", "R")
"""Names of the channel that is read, in order of preference; the only one may have any name."""
INSTALL = 'reading .exr needs OpenEXR; pip install "scgs-warp[exr]"'
MOST_PIXELS = 1 << 26
"""Largest number of pixels, which bounds memory."""


def reads_exr() -> bool:
    """Return whether the optional package is there."""
    return importlib.util.find_spec("OpenEXR") is not None


def read_exr(path: Path) -> np.ndarray:
    """Read one channel of a file as [h, w], float16, float32 or uint32.

    Raises:
        UserError: OpenEXR is not installed, the file is missing or damaged, it is too large, or none of its channels
            is known.
    """
    if not reads_exr():
        raise UserError(f"{path}: {INSTALL}")
    import OpenEXR

    try:
        header = OpenEXR.File(str(path), header_only=True).header()
        low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
        names = [channel.name for channel in header["channels"]]
        if int(np.prod(high - low + 1)) > MOST_PIXELS:
            raise UserError(f"{path}: has more than {MOST_PIXELS:,} pixels; reduce it")
        chosen = next((name for name in CHANNELS if name in names), names[0] if len(names) == 1 else None)
        if chosen is None:
            raise UserError(f"{path}: has the channels {', '.join(names)}; save the depth as channel Z")
        with contextlib.redirect_stdout(io.StringIO()):  # it prints warnings about damaged files
            pixels = OpenEXR.File(str(path), separate_channels=True).channels()[chosen].pixels
    except (RuntimeError, ValueError, KeyError, TypeError, OSError):
        raise UserError(f"{path}: does not decode as OpenEXR; save it again") from None
    if not isinstance(pixels, np.ndarray) or pixels.ndim != 2 or pixels.dtype.hasobject:
        raise UserError(f"{path}: does not decode as OpenEXR; save it again")
    return pixels
