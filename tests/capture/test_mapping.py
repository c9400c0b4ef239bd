"""The mapper begins once more where its first attempt finds few cameras."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from scgs_warp.capture import mapping
from scgs_warp.capture.features import FrameFiles, Links

FILES = FrameFiles(Path("frames"), [f"{k}.png" for k in range(10)], None)


@pytest.mark.parametrize(
    ("first", "planar", "found"),
    [(3, 0.4, 9), (0, 0.4, 9), (5, 0.4, 5), (3, 1.0, 3)],
    ids=["few cameras", "none", "enough", "a turn, which shows no parallax"],
)
def test_a_camera_that_goes_straight_ahead_gets_a_second_beginning(tmp_path, monkeypatch, first, planar, found):
    pycolmap = pytest.importorskip("pycolmap")
    written: list[int] = []

    def attempt(database, images, folder, options, next_image_callback):
        relaxed = options.mapper.init_min_tri_angle < 16 and options.mapper.init_max_forward_motion == 1.0
        count = 9 if relaxed else first
        model = SimpleNamespace(num_reg_images=lambda: count, num_points3D=lambda: 100)
        return {0: model} if count else {}

    monkeypatch.setattr(pycolmap, "incremental_mapping", attempt)
    monkeypatch.setattr(mapping, "links", lambda *_: Links(2000, 1000, 1.0, planar))
    monkeypatch.setattr(mapping, "write_model", lambda model, folder: written.append(model.num_reg_images()))
    assert mapping.solve(tmp_path / "database.db", FILES, tmp_path / "model", 0, lambda: None) == found
    assert written == [found]
