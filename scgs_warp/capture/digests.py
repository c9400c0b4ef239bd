"""What identifies the source of a capture: a hash of its files."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

DIGEST_BYTES = 1 << 20
"""Number of bytes of a file that are hashed at a time. Digests of earlier versions saw as many at both ends only."""


def digest(files: list[Path], names: Sequence[str] = ()) -> str:
    """Hash the content of files, and names, which tell times; dates do not matter."""
    content_hash = hashlib.sha256("/".join(names).encode())  # no name has a slash
    for file in files:
        content_hash.update(f"/{file.stat().st_size},".encode())
        with file.open("rb") as content:
            while part := content.read(DIGEST_BYTES):
                content_hash.update(part)
    return content_hash.hexdigest()


def digest_of_ends(files: list[Path]) -> str:
    """Hash the sizes and both ends of the files, as earlier versions did."""
    content_hash = hashlib.sha256()
    for file in files:
        size = file.stat().st_size
        content_hash.update(f"{size},".encode())
        with file.open("rb") as content:
            content_hash.update(content.read(DIGEST_BYTES))
            if size > DIGEST_BYTES:
                content.seek(max(DIGEST_BYTES, size - DIGEST_BYTES))
                content_hash.update(content.read(DIGEST_BYTES))
    return content_hash.hexdigest()
