"""Files of .splat: read by another program and read back."""

from __future__ import annotations

import numpy as np
import torch

from helpers.export_files import cloud, difference, ordered, ply_columns
from helpers.node_packages import splat_transform
from scgs_warp.export.still import write_still
from scgs_warp.formats.gaussian_files import read_gaussians
from scgs_warp.gaussians import SH_C0
from scgs_warp.types import Gaussians


def test_splat_is_read_by_splat_transform_and_by_us(tmp_path):
    truth = ordered(cloud())
    write_still(tmp_path / "a.splat", truth)
    rows = np.frombuffer((tmp_path / "a.splat").read_bytes(), "<f4").reshape(-1, 8)
    assert len(rows) == 300
    again = ordered(read_gaussians(tmp_path / "a.splat").activate())
    write_still(tmp_path / "again.ply", again)
    limits = {"means": 0.0, "scales": 1e-6, "opacities": 2.1e-3, "colors": 2.1e-3, "degrees": 0.9}
    shown = truth.sh_dc.clamp(-0.5 / SH_C0, 0.5 / SH_C0)  # bytes end at black and white
    limited = Gaussians(**{**vars(truth), "sh_dc": shown})
    found = difference(ply_columns(tmp_path / "again.ply"), limited)
    assert all(found[name] <= limit for name, limit in limits.items()), found
    first, last = rows[:30, 3:6].prod(1).mean(), rows[-30:, 3:6].prod(1).mean()
    assert first > 10 * last  # what matters most comes first
    # it takes a byte q for 2 q / 255 - 1, where the format's first reader has q / 128 - 1
    found = difference(ply_columns(splat_transform(tmp_path / "a.splat", tmp_path / "b.ply"), sort=True), limited)
    assert all(found[name] <= limit + 1e-6 for name, limit in {**limits, "degrees": 2.0}.items()), str(found)


def test_what_is_clipped_is_counted(tmp_path):
    truth = ordered(cloud(20, degree=0))
    truth.sh_dc.clamp_(-0.5, 0.5)[3] = torch.tensor([-2.0, 0.0, 2.0])
    truth.sh_dc[4] = 0.5 / SH_C0  # white
    assert write_still(tmp_path / "a.splat", truth) == 2
