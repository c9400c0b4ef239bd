"""Access to pycolmap: with its log silenced, and with failures of its files said in one line."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..runtime.pycolmap_import import import_pycolmap
from ..storage.files import temporary_of
from .model_files import is_complete

HEADER = b"SQLite format 3\0"
"""First bytes of a database."""


@contextmanager
def quiet() -> Iterator[Any]:
    """Provide pycolmap, with its log silenced for the duration of the context.

    Raises:
        UserError: pycolmap is too old.
    """
    pycolmap = import_pycolmap()
    if not hasattr(pycolmap, "FeatureExtractor"):
        raise UserError(f"pycolmap {pycolmap.__version__} is too old for capture; pip install 'pycolmap>=4.1'")
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    try:
        yield pycolmap
    finally:
        pycolmap.logging.minloglevel = before


@contextmanager
def opened(database: Path) -> Iterator[tuple[Any, Any]]:
    """Provide pycolmap and the opened database; a missing one is made.

    Raises:
        UserError: the database is damaged, or cannot be read or written.
    """
    with quiet() as pycolmap, database_errors(database), pycolmap.Database.open(database) as storage:
        yield pycolmap, storage


@contextmanager
def database_errors(database: Path) -> Iterator[None]:
    """Convert SQLite's errors, which pycolmap raises as RuntimeError, to UserError."""
    try:
        yield
    except RuntimeError as error:
        said = re.search(r"SQLite error: (.*)", str(error))
        if said is None and "database factory" not in str(error):
            raise
        if not is_database(database) or (said is not None and "malformed" in said[1]):
            raise damaged(database) from None
        reason = f" ({said[1]})" if said is not None else ""
        raise UserError(
            f"{database}: cannot be written{reason}; make room, and give the same command again (finished work is kept)"
        ) from None


def is_database(database: Path) -> bool:
    """Return whether the file is missing, empty, or begins as a database does."""
    if not database.is_file():
        return True
    with database.open("rb") as file:
        return file.read(len(HEADER)) in (b"", HEADER)


def damaged(database: Path) -> UserError:
    """Make the error to raise if a file of the work folder is malformed."""
    return UserError(f"{database}: is damaged; remove {database.parent.parent}, and capture again")


def remove_database(database: Path) -> None:
    """Remove a database, and the log that a killed process left: SQLite would play it into a new database."""
    for suffix in ("", "-wal", "-shm"):
        Path(f"{os.fspath(database)}{suffix}").unlink(missing_ok=True)


def write_model(model: Any, folder: Path) -> None:
    """Write a reconstruction. The folder appears when it is complete; pycolmap itself would keep silent about a full
    disk.

    Raises:
        UserError: it cannot be written.
    """
    new = temporary_of(folder)
    try:
        shutil.rmtree(new, ignore_errors=True)
        new.mkdir()
        with quiet():
            model.write_binary(new)
        for file in new.iterdir():
            with open(file, "rb+") as opened_file:
                os.fsync(opened_file.fileno())
        if not is_complete(new):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        shutil.rmtree(folder, ignore_errors=True)
        os.replace(new, folder)
    except OSError as error:
        shutil.rmtree(new, ignore_errors=True)
        raise UserError(
            f"{folder}: cannot be written ({error.strerror}); make room, and give the same command again (finished "
            "work is kept)"
        ) from None


def read_model(folder: Path) -> Any:
    """Read a reconstruction.

    Raises:
        UserError: it is damaged.
    """
    if not is_complete(folder):
        raise damaged(folder)
    with quiet() as pycolmap:
        try:
            return pycolmap.Reconstruction(folder)
        except (RuntimeError, ValueError, IndexError, MemoryError):
            raise damaged(folder) from None
