"""Arrays in .npy and .npz files that claim more than they hold."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest

from scgs_warp.errors import UserError
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
