"""Seconds that the training of a run took, from what it left in its folder."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from ..storage.files import read_text
from ..storage.json_files import as_number, parse_json
from ..visualization.figures import read_log


def training_seconds(folder: Path) -> float | None:
    """Return the seconds of training of a run, from its log or, without one, from its ``metrics.json``."""
    seconds = read_seconds(folder)
    if seconds is not None:
        return seconds
    try:
        value = parse_json(read_text(folder / "metrics.json"))["seconds"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    seconds = as_number(value)
    return None if seconds is None or seconds < 0 else seconds


def read_seconds(folder: Path) -> float | None:
    """Read the seconds of training from the log; None without a log."""
    newest: float | None = None
    for entry in log_entries(folder):
        with suppress(ValueError, KeyError, TypeError):  # skip a damaged line
            newest = float(entry["seconds"])
    return newest


def log_entries(folder: Path) -> list[dict[str, Any]]:
    """Read the lines of ``log.jsonl``; an empty list without a log."""
    log = folder / "log.jsonl"
    return read_log(log) if log.is_file() else []
