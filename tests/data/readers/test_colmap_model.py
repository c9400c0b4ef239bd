"""Sparse models of COLMAP: where they are found, and files that claim more than they hold."""

from __future__ import annotations

import struct

import pytest

from helpers.layouts import write_colmap
from scgs_warp.data import load
from scgs_warp.data.readers.colmap_model import read_model
from scgs_warp.errors import UserError


@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
def test_binary_counts_are_not_believed(tmp_path, file):
    write_colmap(tmp_path)
    path = tmp_path / f"sparse/0/{file}.bin"
    data = path.read_bytes()
    for count in (2**63, 10**9, len(data)):
        path.write_bytes(struct.pack("<Q", count) + data[8:])
        with pytest.raises(UserError, match=rf"{file}\.bin: truncated or damaged"):
            read_model(path.parent)
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        with pytest.raises(UserError, match=rf"{file}\.bin"):
            read_model(path.parent)


def test_colmap_is_found_where_it_is_left(tmp_path):
    write_colmap(tmp_path)
    expected = load(tmp_path).fingerprint
    (tmp_path / "sparse/0").rename(tmp_path / "moved")
    (tmp_path / "sparse").rmdir()
    for place in ("sparse", "colmap/sparse/0", "sparse/3"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "moved").rename(tmp_path / place)
        assert load(tmp_path).fingerprint == expected, place
        (tmp_path / place).rename(tmp_path / "moved")


def test_colmap_takes_the_largest_model(tmp_path):
    write_colmap(tmp_path, count=14)
    write_colmap(tmp_path / "other", count=4)
    (tmp_path / "sparse/0").rename(tmp_path / "sparse/1")
    (tmp_path / "other/sparse/0").rename(tmp_path / "sparse/0")
    assert len(load(tmp_path)) == 12
