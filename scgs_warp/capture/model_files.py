"""Whether the files of a model in COLMAP's binary format are complete. pycolmap reads on behind the end of a file: for
minutes, if what it takes for a number of points is large."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

PARAMETERS = (3, 4, 4, 5, 8, 8)
"""Number of parameters of each camera model, by COLMAP's number of it: ``SIMPLE_PINHOLE`` to ``OPENCV_FISHEYE``."""

End = Callable[[bytes, int], int]
"""Function from the content of a file and the start of an entry to the entry's end."""


def is_complete(folder: Path) -> bool:
    """Return whether the files of a model are there, and hold all entries that they announce."""
    try:
        return all(_is_complete((folder / name).read_bytes(), end) for name, end in ENTRIES.items())
    except FileNotFoundError:
        return False


def _is_complete(content: bytes, end: End) -> bool:
    try:
        at = 8
        for _ in range(_number("<Q", content, 0)):
            at = end(content, at)
            if at > len(content):
                return False
    except (struct.error, ValueError):  # behind the end
        return False
    return len(content) >= at


def _number(form: str, content: bytes, at: int) -> int:
    return struct.unpack_from(form, content, at)[0]


def _camera(content: bytes, at: int) -> int:
    model = _number("<i", content, at + 4)
    return at + 24 + 8 * (PARAMETERS[model] if 0 <= model < len(PARAMETERS) else min(PARAMETERS))


def _rig(content: bytes, at: int) -> int:
    return at + 16  # of one camera, as all rigs of captures are to COLMAP


def _frame(content: bytes, at: int) -> int:
    return at + 68 + 16 * _number("<I", content, at + 64)


def _image(content: bytes, at: int) -> int:
    name_end = content.index(b"\0", at + 64) + 1
    return name_end + 8 + 24 * _number("<Q", content, name_end)


def _point(content: bytes, at: int) -> int:
    return at + 51 + 8 * _number("<Q", content, at + 43)


ENTRIES: dict[str, End] = {
    "cameras.bin": _camera,
    "rigs.bin": _rig,
    "frames.bin": _frame,
    "images.bin": _image,
    "points3D.bin": _point,
}
"""Files of a model. Each begins with the number of its entries."""
