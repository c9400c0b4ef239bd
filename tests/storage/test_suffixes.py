"""Suffixes of file names."""

from __future__ import annotations

from pathlib import Path

import pytest

from scgs_warp.storage.suffixes import longest_suffix

KNOWN = (".ply", ".compressed.ply", ".json", "meta.json", ".splat")


@pytest.mark.parametrize(
    ("name", "suffix"),
    [
        ("a.ply", ".ply"),
        ("a.b.PLY", ".ply"),
        ("a.compressed.ply", ".compressed.ply"),
        ("A.Compressed.Ply", ".compressed.ply"),
        ("folder.splat/a.ply", ".ply"),
        ("meta.json", "meta.json"),
        ("x/META.json", "meta.json"),
        ("lod-meta.json", ".json"),
        ("a.json", ".json"),
        (".ply", ""),
        (".compressed.ply", ".ply"),
        ("compressed.ply", ".ply"),
        ("a.txt", ""),
        ("ply", ""),
        ("", ""),
    ],
)
def test_the_longest_suffix_is_found(name, suffix):
    assert longest_suffix(name, KNOWN) == longest_suffix(Path(name), KNOWN[::-1]) == suffix
