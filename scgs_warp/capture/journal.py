"""Journal of the finished stages of a capture. Interrupted work is resumed; finished work and other files are kept."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..storage.files import read_text
from ..storage.json_files import parse_json, write_json
from ..storage.locks import AlreadyLocked, lock_file
from ..storage.output_folders import paths_in
from .writing import FILE

WORK = "work"
"""Folder of intermediate files; it may be deleted when the data set is complete."""
JOURNAL = "journal.json"
LOCK = ".lock"
LEFT = re.compile(r"\.journal\.json\.\w+\.tmp|\.lock")
"""Names of what a killed writer of the journal leaves."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)


class Journal:
    """Chain of stages. A stage's result is reused if the settings of the stage and of all earlier stages are
    unchanged."""

    def __init__(self, folder: Path, digest: Callable[[bool], str], marker: str = FILE) -> None:
        """
        Args:
            folder: must not exist, or be empty, or hold work on the same source.
            digest: returns the digest of the source, or that of earlier versions.
            marker: file whose presence marks a finished folder.

        Raises:
            UserError: the folder holds something else.
        """
        self.folder = folder
        self.work = folder / WORK
        self.file = self.work / JOURNAL
        self._marker, self._digest = marker, digest
        self._source = _hashed(digest(False))
        self.earlier = False
        """True if the folder holds work of an earlier version, which digested sources in another way."""
        self._load()

    def _load(self) -> None:
        """Read what the folder holds."""
        folder = self.folder
        self._stages: dict[str, dict[str, Any]] = {}
        if folder.exists() and (not folder.is_dir() or paths_in(self.folder)):
            content = {"source": self._source, "stages": {}} if self._is_bare() else _read(self.file)
            if content is None:
                what = "a finished data set" if (folder / self._marker).is_file() else "something else"
                raise UserError(f"{folder}: exists and holds {what}; give another --output, or remove it")
            if content.get("source") != self._source:
                self._source, self.earlier = _hashed(self._digest(True)), True
            if content.get("source") != self._source:
                raise UserError(
                    f"{folder}: holds the capture of another video; give another --output, or remove the folder"
                )
            self._stages = {
                name: entry for name, entry in content["stages"].items() if isinstance(entry, dict) and "key" in entry
            }
        self._key = self._source
        self.finished = (folder / self._marker).exists()

    def _is_bare(self) -> bool:
        """Return whether the folder holds only what an attempt leaves that ends before its first entry: on a full disk,
        or by a kill."""
        if not self.folder.is_dir() or self.work.is_symlink() or paths_in(self.folder) != [self.work]:
            return False
        return self.work.is_dir() and all(LEFT.fullmatch(path.name) for path in self.work.iterdir())

    @contextmanager
    def started(self) -> Iterator[None]:
        """Make the folder, and keep other processes from working in it for the duration of the context.

        Raises:
            UserError: another process works in it, or it cannot be made.
        """
        try:
            self.work.mkdir(parents=True, exist_ok=True)
            lock = lock_file(self.work / LOCK)
        except AlreadyLocked:
            raise UserError(
                f"{self.folder}: another capture is running here; wait for it, or give another --output"
            ) from None
        except OSError as error:
            raise self._unwritable(error) from None
        try:
            self._load()  # another process may have been at work
            try:
                self._save()
            except OSError as error:
                raise self._unwritable(error) from None
            yield
        finally:
            os.close(lock)

    def _unwritable(self, error: OSError) -> UserError:
        return UserError(f"{self.folder}: cannot be written ({error.strerror}); choose another --output, or make room")

    def stage(self, name: str, settings: Any, make: Callable[[], Any], clear: Callable[[], None]) -> Any:
        """Return the result of a stage: the stored result, or a new one.

        Args:
            settings: JSON; everything on which the result depends, besides earlier stages and the source.
            make: runs or resumes the stage; returns JSON.
            clear: removes the files of an attempt with other settings.

        Raises:
            UserError: the folder was finished with other settings.
        """
        self._key = _hashed(self._key + json.dumps([name, settings], sort_keys=True))
        stored = self._stages.get(name)
        if stored is not None and stored["key"] == self._key and "result" in stored:
            return stored["result"]
        if self.finished and (stored is None or stored["key"] != self._key):
            raise UserError(
                f"{self.folder}: is a finished capture, made with other settings ({name}); give another --output, or "
                "remove the folder"
            )
        if stored is None or stored["key"] != self._key:
            clear()
            self._stages[name] = {"key": self._key}
            self._save()
        result = make()
        self._stages[name] = {"key": self._key, "result": result}
        self._save()
        return result

    def knows(self, name: str) -> bool:
        """Return whether the stage was begun."""
        return name in self._stages

    def result(self, name: str) -> Any:
        """Return the stored result of a finished stage."""
        return self._stages[name]["result"]

    def damaged(self, name: str) -> UserError:
        """Make the error to raise if a stored result is malformed."""
        return UserError(f"{self.file}: the result of {name} is damaged; remove {self.folder}, and capture again")

    def _save(self) -> None:
        write_json(self.file, {"source": self._source, "stages": self._stages})


@contextmanager
def disk_errors(folder: Path) -> Iterator[None]:
    """Convert errors of a full disk, which need not name a file, to UserError.

    Args:
        folder: folder of the capture.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        raise UserError(
            f"{folder}: cannot be written ({error.strerror}); make room, and give the same command again (finished "
            "work is kept)"
        ) from None


def _hashed(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _read(file: Path) -> dict[str, Any] | None:
    try:
        content = parse_json(read_text(file))
        return content if isinstance(content["stages"], dict) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
