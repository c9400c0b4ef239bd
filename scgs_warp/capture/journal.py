"""What has been done in a folder: interrupted work goes on, finished work stays, and nothing else is touched."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..storage.json_files import parse_json
from .writing import FILE, write_text

WORK = "work"
"""Folder of what lies between the video and the data set; may be deleted when the data set is done."""
JOURNAL = "journal.json"


class Journal:
    """Stages that follow from each other. A stage counts as done as long as it, and all before it, would be done with
    the same settings."""

    def __init__(self, folder: Path, source: str) -> None:
        """
        Args:
            folder: must not exist, or be empty, or hold unfinished work on the same source.
            source: tells what was filmed from anything else.

        Raises:
            UserError: it holds something else.
        """
        self.folder = folder
        self.work = folder / WORK
        self.file = self.work / JOURNAL
        self._source = self._key = hashlib.sha256(source.encode()).hexdigest()
        self._stages: dict[str, dict[str, Any]] = {}
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            content = _read(self.file)
            if content is None:
                raise UserError(f"{folder}: exists and holds something else; give another --output, or remove it")
            if content.get("source") != self._source:
                raise UserError(
                    f"{folder}: holds the capture of another video; give another --output, or remove the folder"
                )
            self._stages = {
                name: found for name, found in content["stages"].items() if isinstance(found, dict) and "key" in found
            }
        self.finished = (folder / FILE).exists()

    def start(self) -> None:
        """Make the folder."""
        try:
            self.work.mkdir(parents=True, exist_ok=True)
            self._save()
        except OSError as error:
            raise UserError(
                f"{self.folder}: cannot be written ({error.strerror}); choose another --output, or make room"
            ) from None

    def stage(self, name: str, settings: Any, make: Callable[[], Any], clear: Callable[[], None]) -> Any:
        """The result of a stage: of ``make``, or of the time when it was made with the same settings.

        Args:
            settings: JSON, everything that the result depends on beside earlier stages and the source.
            make: does it, or goes on with it; what it returns is JSON.
            clear: removes what another attempt, with other settings, has left.

        Raises:
            UserError: the folder is finished, with other settings.
        """
        self._key = hashlib.sha256((self._key + json.dumps([name, settings], sort_keys=True)).encode()).hexdigest()
        found = self._stages.get(name)
        if found is not None and found["key"] == self._key and "result" in found:
            return found["result"]
        if self.finished and (found is None or found["key"] != self._key):
            raise UserError(
                f"{self.folder}: is a finished capture, made with other settings ({name}); give another --output, or "
                "remove the folder"
            )
        if found is None or found["key"] != self._key:
            clear()
            self._stages[name] = {"key": self._key}
            self._save()
        result = make()
        self._stages[name] = {"key": self._key, "result": result}
        self._save()
        return result

    def result(self, name: str) -> Any:
        """Of a stage that is done."""
        return self._stages[name]["result"]

    def damaged(self, name: str) -> UserError:
        """The error to raise where the result of a stage is not what ``make`` returns."""
        return UserError(f"{self.file}: what it says of {name} is damaged; remove {self.folder}, and capture again")

    def _save(self) -> None:
        content = {"source": self._source, "stages": self._stages}
        write_text(self.file, json.dumps(content, indent=1) + "\n")


def _read(file: Path) -> dict[str, Any] | None:
    try:
        content = parse_json(file.read_text(encoding="utf-8"))
        return content if isinstance(content["stages"], dict) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
