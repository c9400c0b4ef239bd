"""Names from other people's files stay in their folder."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from scgs_warp.errors import UserError
from scgs_warp.storage.safe_paths import inside, is_regular


@pytest.mark.parametrize("name", ["a.png", "./a.png", "b/../a.png", "b\\..\\a.png", "../data/a.png"])
def test_names_of_the_same_file(tmp_path: Path, name: str):
    assert inside(tmp_path / "data", name, "list.json: file") == tmp_path / "data" / "a.png"


@pytest.mark.parametrize(
    "name",
    [
        "../data-secret/a.png",
        "../data.png",
        "..",
        ".",
        "a/../..",
        "/etc/hostname",
        "C:/a.png",
        "c:\\a.png",
        "b\\..\\..\\a",
    ],
)
def test_names_that_lead_out_are_refused(tmp_path: Path, name: str):
    """A sibling that begins with the folder's own name is outside as well."""
    with pytest.raises(UserError, match=r"list\.json: file is .* leads out of"):
        inside(tmp_path / "data", name, "list.json: file")


@pytest.mark.parametrize("name", ["", "  ", "a\0b", "\ud800", "x" * 300, "x/" * 1500])
def test_names_of_no_file_are_refused(tmp_path: Path, name: str):
    with pytest.raises(UserError, match="names no file; name the mesh"):
        inside(tmp_path, name, "list.json: file", "mesh")


def test_only_files_are_regular(tmp_path: Path):
    (tmp_path / "a").write_bytes(b"a")
    assert is_regular(tmp_path / "a") and not is_regular(tmp_path)
    if Path("/dev/zero").exists():
        assert not is_regular(Path("/dev/zero"))
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        assert not is_regular(tmp_path / "pipe")
    with pytest.raises(OSError):
        is_regular(tmp_path / "missing")
