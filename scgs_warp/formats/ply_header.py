"""Plausibility check of PLY headers, done before a reader allocates memory for the announced rows."""

from __future__ import annotations

from pathlib import Path


def check_ply_counts(path: Path) -> None:
    """Refuse a PLY file whose header announces more rows than the file has bytes.

    Raises:
        ValueError: the header announces too many rows.
        OSError: the file cannot be read.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(1 << 16).split(b"end_header")[0]
    for line in head.splitlines():
        words = line.split()
        if len(words) == 3 and words[0] == b"element" and words[2].isdigit() and int(words[2][:20]) > size:
            raise ValueError(f"counts {words[2][:20].decode()} rows in {size} bytes")
