"""Folders of the user's own."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from scgs_warp.storage.own_folder import own_folder


def test_a_user_without_a_home_has_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", nowhere)
    for name in ("XDG_DATA_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    folder = own_folder("edits", tmp_path / "run")
    assert folder.is_relative_to(tempfile.gettempdir()) and folder.parent.name == "edits"
