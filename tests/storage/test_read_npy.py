"""Arrays in .npy and .npz files that claim more than they hold."""

from __future__ import annotations

import io
import tracemalloc
import zipfile

import numpy as np
import pytest

from scgs_warp.errors import UserError
from scgs_warp.storage import numpy_files
from scgs_warp.storage.numpy_files import read_npy


def test_arrays_that_claim_more_than_they_hold(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)})
    (tmp_path / "a.npy").write_bytes(header.getvalue() + bytes(240))
    with pytest.raises(UserError, match=r"a\.npy: no sound numpy file"):
        read_npy(tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("data.npy", header.getvalue() + bytes(240))
    with pytest.raises(UserError, match=r"a\.npz: no sound numpy file"):
        read_npy(tmp_path / "a.npz", "data")
    for array in (np.arange(6, dtype=np.int32).reshape(2, 3), np.asfortranarray(np.eye(3, dtype=np.float32)[:2])):
        np.save(tmp_path / "b.npy", array)
        np.testing.assert_array_equal(read_npy(tmp_path / "b.npy"), array)


def test_what_a_header_claims_is_not_allocated(tmp_path, monkeypatch):
    """25 million numbers, of which the file holds 30; and no more than an array may have."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (25_000_000,)})
    (tmp_path / "a.npy").write_bytes(header.getvalue() + bytes(240))
    tracemalloc.start()
    with pytest.raises(UserError, match=r"a\.npy: no sound numpy file"):
        read_npy(tmp_path / "a.npy")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 * 2**20
    np.save(tmp_path / "b.npy", np.arange(30.0))
    for most, fits in ((240, True), (239, False)):
        monkeypatch.setattr(numpy_files, "MAX_ARRAY_BYTES", most)
        if fits:
            assert read_npy(tmp_path / "b.npy").tolist() == list(range(30))
        else:
            with pytest.raises(UserError, match=r"b\.npy: no sound numpy file"):
                read_npy(tmp_path / "b.npy")


ARRAYS = {
    "numbers": np.array([1.5, 2.5]),
    "flags": np.array([True, False]),
    "texts": np.array(["1", "2"]),
    "complex": np.array([1j, 2.0]),
    "dates": np.array(["2020-01-01"], "M8[D]"),
}


@pytest.mark.parametrize("kind", ARRAYS)
@pytest.mark.parametrize("content", ["numbers", "flags", "texts"])
def test_other_content_is_refused(tmp_path, content, kind):
    """Text that could be read as numbers is none, and numbers are no flags."""
    np.save(tmp_path / "a.npy", ARRAYS[kind])
    if content == kind:
        np.testing.assert_array_equal(read_npy(tmp_path / "a.npy", content=content), ARRAYS[kind])
    else:
        with pytest.raises(UserError, match=r"a\.npy: no sound numpy file"):
            read_npy(tmp_path / "a.npy", content=content)
