"""Choice of the reader by what lies in a folder; damaged files of every layout."""

from __future__ import annotations

import time
import tracemalloc

import numpy as np
import pytest

from helpers.data_faults import message
from helpers.layouts import write_colmap, write_nerfies, write_panoptic, write_poses_bounds
from helpers.nerfstudio_files import write as write_nerfstudio
from scgs_warp.data import load
from scgs_warp.errors import UserError

WRITERS = {
    "nerfies": write_nerfies,
    "panoptic": write_panoptic,
    "bounds": write_poses_bounds,
    "colmap": write_colmap,
    "nerfstudio": write_nerfstudio,
}


def test_nothing_known(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    text = message(tmp_path)
    names = (
        "transforms_train.json",
        "transforms.json",
        "dataset.json",
        "train_meta.json",
        "poses_bounds.npy",
        "sparse/0",
    )
    assert all(name in text for name in names)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("layout", WRITERS)
def test_mutated_files_are_read_or_refused(tmp_path, layout, seed):
    """Whatever bytes change: a data set, or one line; soon, and without the memory that a damaged count asks for."""
    random = np.random.default_rng(seed)
    folder = tmp_path / "scene"
    WRITERS[layout](folder)
    files = sorted(f for f in folder.rglob("*") if f.is_file() and f.suffix not in (".png", ".jpg"))
    original = {file: file.read_bytes() for file in files}
    for _ in range(12):
        file = files[random.integers(len(files))]
        data = bytearray(original[file])
        if random.random() < 0.3:
            data = data[: random.integers(len(data))]
        else:
            for _ in range(4):
                data[random.integers(min(len(data), 300))] = random.integers(256)
        file.write_bytes(data)
        began = time.monotonic()
        tracemalloc.start()
        try:
            load(folder)
        except UserError as error:
            assert "\n" not in str(error)
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert time.monotonic() - began < 20 and peak < 100e6
        file.write_bytes(original[file])
