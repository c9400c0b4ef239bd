"""What must not go wrong quietly: files that claim too much, numbers that are not finite, disks that refuse."""

from __future__ import annotations

import gzip
import struct
import tracemalloc
from pathlib import Path

import pytest

from scgs_warp.data import gaussian_files
from scgs_warp.errors import UserError


def zeros_spz(path: Path, count: int) -> Path:
    """A file of harmonics of degree 3 that are all the same: a thousandth of what it holds."""
    head = struct.pack("<IIIBBBB", 0x5053474E, 3, count, 3, 12, 0, 0)
    path.write_bytes(gzip.compress(head + bytes(65 * count)))
    return path


def test_reading_spz_takes_a_few_times_what_it_holds(tmp_path):
    count = 50_000
    path = zeros_spz(tmp_path / "a.spz", count)
    tracemalloc.start()
    try:
        found = gaussian_files.read_gaussians(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(found.means) == count
    assert 65 * count < peak < 600 * count  # 59 numbers of 4 bytes, the file's bytes, masks


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory")])
def test_what_does_not_fit_into_memory_is_one_line(tmp_path, monkeypatch, error):
    def refuse(path: Path) -> None:
        raise error

    monkeypatch.setitem(gaussian_files.READERS, ".spz", refuse)
    with pytest.raises(UserError, match=r"a\.spz: .*fit into memory; export"):
        gaussian_files.read_gaussians(tmp_path / "a.spz")
