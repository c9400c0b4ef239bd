"""Colours of control points."""

from __future__ import annotations

from scgs_warp.editor.overlays import CHOSEN, HELD, PINNED, PLAIN, node_colors


def test_colours_of_control_points():
    colors = node_colors(5, chosen=(2,), held=(1, 2), pins=(0, 1))
    assert [tuple(row) for row in colors] == [PINNED, HELD, CHOSEN, PLAIN, PLAIN]
