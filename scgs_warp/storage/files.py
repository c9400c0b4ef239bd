"""Whole files: bounded reading of regular files only, and atomic writing."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from ..errors import UserError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

MAX_TEXT = 2**27
"""Largest text file accepted, in bytes: the poses of 100,000 frames take about half of it."""
KEPT_CHARACTERS = 50
"""Number of characters of a name, of up to 4 bytes each, that names of temporary files repeat."""


def open_regular(path: Path | str) -> BinaryIO:
    """Open a regular file for reading.

    A pipe without a writer is refused instead of waited for, and so are devices: ``/dev/zero`` never ends.

    Raises:
        OSError: the file is missing, cannot be opened, or is not a regular file.
    """
    flags = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
    number = os.open(path, flags)
    try:
        if not stat.S_ISREG(os.fstat(number).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        return os.fdopen(number, "rb")
    except BaseException:
        os.close(number)
        raise


def read_text(path: Path | str, most: int = MAX_TEXT, errors: str = "strict") -> str:
    """Read a UTF-8 text of at most ``most`` bytes from a regular file; line ends become ``\\n``, and the mark that
    editors of Windows put at the beginning is left out.

    Args:
        errors: treatment of bytes that are no UTF-8, as for ``bytes.decode``.

    Raises:
        OSError: the file is missing, not a regular file, cannot be read, or is too large.
        UnicodeDecodeError: the bytes are no UTF-8 text.
    """
    content = bytearray()
    with open_regular(path) as file:
        while piece := file.read(2**20):  # read(most) would allocate that much for the smallest file
            content += piece
            if len(content) > most:
                raise OSError(errno.EFBIG, f"larger than {most >> 20} MiB", str(path))
    return content.decode("utf-8", errors).removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")


def read_bytes(path: Path, remedy: str) -> bytes:
    """Read a whole regular file.

    Args:
        remedy: advice for a missing file; ends the message.

    Raises:
        UserError: the file is missing or cannot be read.
    """
    try:
        with open_regular(path) as file:
            return file.read()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; {remedy}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); {remedy}") from None


def for_ffmpeg(path: Path) -> str:
    """Return the name by which FFmpeg opens a file: in a relative one, it takes what stands before a colon (``clip:2``)
    for a protocol."""
    return str(path.absolute())


def hidden_beside(path: Path, ending: str) -> Path:
    """Return a hidden name beside ``path``. It begins with that of ``path``, shortened: names end at 255 bytes."""
    return path.with_name(f".{path.name[:KEPT_CHARACTERS]}.{ending}")


def temporary_of(path: Path) -> Path:
    """Return the temporary name for writing ``path`` in a folder that has one writer. It is fixed, so that killed
    processes leave one file at most."""
    return hidden_beside(path, "tmp")


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

    Readers see either the old file or the complete new one, even after a loss of power. Several processes may write one
    file: each has a temporary file of its own, and the last one to finish wins.

    Raises:
        UserError: the disk is full or the folder cannot be written; the old file is intact.
    """
    if not path.name:
        raise UserError(f"{path}: is no file name; give one")
    try:
        with new_beside(path) as temporary:
            with open(temporary, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
    except OSError as error:
        raise UserError(
            f"{path}: cannot be written ({error.strerror}); make room or give another name, an earlier file is intact"
        ) from error
    sync_folder(path.parent)


@contextmanager
def new_beside(path: Path, folder: bool = False) -> Iterator[Path]:
    """Yield a new, empty temporary file beside ``path``, or a folder, and remove at the end what has not been renamed.
    What killed writers of ``path`` left there is removed first: a temporary file is locked as long as its writer lives.

    Raises:
        OSError: the file or folder cannot be made.
    """
    _remove_leftovers(path)
    temporary, number = _make_temporary(path, folder)
    try:
        yield temporary
    finally:
        if number is not None:
            os.close(number)
        with suppress(OSError):
            _remove(temporary)


def _make_temporary(path: Path, folder: bool) -> tuple[Path, int | None]:
    """Make a temporary file or folder for ``path`` under a new name. It is locked until the returned descriptor is
    closed; None: this system has no locks."""
    while True:
        temporary = hidden_beside(path, f"{secrets.token_hex(4)}.tmp")
        if folder:
            temporary.mkdir()
        else:
            temporary.touch(exist_ok=False)
        if fcntl is None:
            return temporary, None
        with suppress(FileNotFoundError):  # Another process took it for a leftover before it was locked.
            number = os.open(temporary, os.O_RDONLY if folder else os.O_RDWR)
            with suppress(OSError):  # a file system without locks
                fcntl.flock(number, fcntl.LOCK_EX)
            if temporary.exists():
                return temporary, number
            os.close(number)


def _remove_leftovers(path: Path) -> None:
    """Remove temporary files and folders of ``path`` whose writers were killed; one that is locked has a writer."""
    if fcntl is None:
        return
    pattern = re.compile(re.escape(hidden_beside(path, "").name) + r"[0-9a-f]{8}\.tmp")
    with suppress(OSError):
        names = [entry.name for entry in os.scandir(path.parent) if pattern.fullmatch(entry.name)]
        for left in (path.with_name(name) for name in names):
            with suppress(OSError):
                if left.is_symlink():  # no writer makes a link; its target is not touched
                    left.unlink()
                    continue
                number = os.open(left, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
                try:
                    fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    _remove(left)
                finally:
                    os.close(number)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
