"""Headers of PLY files: what they announce is compared with the file before anything is parsed."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from scgs_warp.formats.ply_header import parse_ply


def text_ply(path: Path, count: int, rows: str) -> Path:
    header = f"ply\nformat ascii 1.0\nelement vertex {count}\nproperty float x\nend_header\n"
    path.write_text(header + rows)
    return path


def test_more_rows_than_bytes_are_refused_before_parsing(tmp_path, monkeypatch):
    path = text_ply(tmp_path / "a.ply", 100, "1\n")
    size = path.stat().st_size
    monkeypatch.setattr(PlyData, "read", lambda *_: pytest.fail("parsed"))
    for count in (size + 10, 10**12, 10**30):
        with pytest.raises(ValueError, match=r"counts \d+ rows in \d+ bytes"):
            parse_ply(text_ply(tmp_path / "a.ply", count, "1\n"))


def test_overflow_and_empty_tables_are_read_without_a_warning(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(parse_ply(text_ply(tmp_path / "a.ply", 0, ""))["vertex"].data) == 0
        found = parse_ply(text_ply(tmp_path / "b.ply", 2, "1e60\n2\n"))["vertex"].data["x"]
    np.testing.assert_array_equal(found, [np.inf, 2.0])
