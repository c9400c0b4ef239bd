"""PLY files: the parser, behind a plausibility check of the rows that the header announces; comments of headers."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..storage.files import open_regular

if TYPE_CHECKING:
    from plyfile import PlyData

ANTIALIASED_COMMENT = "SplatRenderMode: mip"
"""Comment that marks Gaussians trained with the antialiasing compensation, as Brush writes it."""
ANTIALIASED_WORDS = ([b"SplatRenderMode:", b"mip"], [b"antialiased", b"1"])
"""Comments that mark them, by Brush and by Postshot."""
HEAD_BYTES = 1 << 16
"""Longest header that is searched."""


def check_ply_counts(path: Path) -> None:
    """Refuse a PLY file whose header announces more rows than the file has bytes.

    Raises:
        ValueError: the header announces too many rows.
        OSError: the file cannot be read.
    """
    size = path.stat().st_size
    with open_regular(path) as file:
        head = file.read(HEAD_BYTES).split(b"end_header")[0]
    for line in head.splitlines():
        words = line.split()
        if len(words) == 3 and words[0] == b"element" and words[2].isdigit() and int(words[2][:20]) > size:
            raise ValueError(f"counts {words[2][:20].decode()} rows in {size} bytes")


def parse_ply(path: Path) -> PlyData:
    """Parse a PLY file whose header announces no more rows than there can be.

    Numbers in text that overflow become infinite, without a warning; tables without rows stay empty.

    Raises:
        ValueError: the header announces too many rows.
        plyfile.PlyParseError: the file is no PLY, as for ``PlyData.read``, which may raise other errors for damage.
        OSError: the file cannot be read.
    """
    from plyfile import PlyData

    check_ply_counts(path)
    with np.errstate(over="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy's, of text without rows
        return PlyData.read(str(path))


def has_antialiased_comment(path: Path) -> bool:
    """Return whether a comment marks the Gaussians of a PLY file as trained with the antialiasing compensation; False
    if the file cannot be read."""
    try:
        with open_regular(path) as file:
            lines = file.read(HEAD_BYTES).split(b"end_header")[0].splitlines()
    except OSError:
        return False  # The reader of the Gaussians reports this.
    return any(words[:1] == [b"comment"] and words[1:] in ANTIALIASED_WORDS for words in map(bytes.split, lines))
