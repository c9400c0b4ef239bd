"""The contact sheet of a capture."""

from __future__ import annotations

import numpy as np

from scgs_warp.capture.pictures import sheet
from scgs_warp.capture.source import read_rgb


def test_pictures_held_upright_and_across_share_a_sheet(tmp_path):
    pictures = [np.full((90, 160, 3), 90, np.uint8), np.full((160, 90, 3), 40, np.uint8)]
    sheet(tmp_path / "sheet.png", lambda k: (pictures[k], None), ["one", "two"], {0, 1})
    drawn = read_rgb(tmp_path / "sheet.png")
    assert {90, 40, 255} <= set(np.unique(drawn).tolist())
    assert (drawn[-30:, :200] == 255).all(), "below the one across, paper is left"
