"""Imports of scenes of other programs: without progress, read back, and refused."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from scgs_warp.capture import import_scene
from scgs_warp.data import load
from scgs_warp.errors import UserError


@contextmanager
def silent(total: int, text: str):
    yield SimpleNamespace(advance=lambda count=1: None)


def entries(folder: Path):
    """Return the frames of an import, in the order of time."""
    found = [entry for split in ("train", "test") for entry in load(folder, split).entries]
    return sorted(found, key=lambda entry: entry.time)


def refused(source: Path, tmp_path: Path, words: str) -> None:
    """Expect one line with ``words``, and nothing written."""
    with pytest.raises(UserError, match=words) as caught:
        import_scene(source, tmp_path / "out", silent)
    assert "\n" not in str(caught.value) and not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".out*"))
