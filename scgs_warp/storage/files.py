"""Whole files: reading with helpful error messages, and atomic writing."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from ..errors import UserError
from .safe_paths import is_regular


def read_bytes(path: Path, remedy: str) -> bytes:
    """Read a whole file.

    Args:
        remedy: advice for a missing file; ends the message.

    Raises:
        UserError: the file is missing or cannot be read.
    """
    try:
        if not is_regular(path):
            raise UserError(f"{path}: not a file; {remedy}")
        return path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; {remedy}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); {remedy}") from None


def temporary_of(path: Path) -> Path:
    """Return the temporary name for writing ``path``. It is fixed, so that killed processes leave one file at most."""
    return path.with_name(f".{path.name}.tmp")


def sync_folder(folder: Path) -> None:
    """Make renames in ``folder`` survive a loss of power, where the system supports this."""
    with suppress(OSError):  # Windows and some network shares cannot
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def write_and_flush(path: Path, content: bytes) -> None:
    """Write a new file and flush it to the disk; remove it on any exception.

    Raises:
        OSError: the file cannot be written.
    """
    try:
        path.unlink(missing_ok=True)  # in somebody else's folder it may be a link that leads elsewhere
        with open(path, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    except BaseException:
        with suppress(OSError):
            path.unlink(missing_ok=True)
        raise


def write_atomically(path: Path, content: bytes) -> None:
    """Write to a temporary file, flush it, and rename it.

    Readers see either the old file or the complete new one, even after a loss of power.

    Raises:
        UserError: the disk is full or the folder cannot be written; the old file is intact.
    """
    temporary = temporary_of(path)
    try:
        write_and_flush(temporary, content)
        os.replace(temporary, path)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise UserError(f"{path}: cannot be written ({error.strerror}); the previous file is intact") from error
    sync_folder(path.parent)
