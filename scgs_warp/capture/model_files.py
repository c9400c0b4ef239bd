"""Check that the files of a model in COLMAP's binary format are complete. pycolmap reads past the end of a truncated
file, for minutes if it takes a large number for the number of entries."""

from __future__ import annotations

import struct
from pathlib import Path

from ..data.readers.colmap_model import read_model
from ..errors import UserError
from ..storage.files import read_bytes

FILES = ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin")
RIG_BYTES = 16
"""Size of a rig of one camera, as all rigs of captures are to COLMAP."""
FRAME_BYTES, IMAGE_BYTES = 68, 16
"""Size of a frame without images, which ends with their number, and of each of its images."""


def is_complete(folder: Path) -> bool:
    """Return whether the files of a model are there, and hold all entries that they announce."""
    if not all((folder / name).is_file() for name in FILES):
        return False
    try:
        read_model(folder)
        frames, rigs = (read_bytes(folder / f"{name}.bin", "") for name in ("frames", "rigs"))
        return _holds_frames(frames) and _holds_rigs(rigs)
    except (UserError, struct.error):
        return False


def _holds_rigs(content: bytes) -> bool:
    return len(content) >= 8 + RIG_BYTES * struct.unpack_from("<Q", content)[0]


def _holds_frames(content: bytes) -> bool:
    at = 8
    for _ in range(struct.unpack_from("<Q", content)[0]):
        at += FRAME_BYTES
        at += IMAGE_BYTES * struct.unpack_from("<I", content, at - 4)[0]
    return len(content) >= at
