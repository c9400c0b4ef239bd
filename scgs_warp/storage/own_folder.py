"""Folders of the user's own, for what belongs to a run or file but cannot or should not be kept beside it."""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from pathlib import Path


def own_folder(kind: str, source: Path) -> Path:
    """Return the user's folder for things of a kind that belong to a run or file; it may not exist yet."""
    base = os.environ.get("XDG_DATA_HOME") or (
        os.environ.get("LOCALAPPDATA") if sys.platform == "win32" else str(_home() / ".local" / "share")
    )
    path = source.resolve()
    mark = hashlib.sha256(os.fsencode(path)).hexdigest()[:8]
    return Path(base or _home()) / "scgs_warp" / kind / f"{path.name or 'scene'}-{mark}"


def _home() -> Path:
    """Return the user's home or, for one without (a number in a container), the folder of temporary files."""
    try:
        return Path.home()
    except RuntimeError:
        return Path(tempfile.gettempdir())
