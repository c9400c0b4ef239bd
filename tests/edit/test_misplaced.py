"""Scripts that name places outside the scene."""

from __future__ import annotations

from helpers.edit_scenes import bar_scene
from helpers.edit_scripts import SCRIPT, changed
from scgs_warp.edit import EditSession
from scgs_warp.edit.misplaced import misplaced


def test_only_places_outside_the_scene_are_described():
    engine = EditSession(bar_scene()).engine
    assert misplaced(SCRIPT, engine) is None
    found = misplaced(changed("handles.0.nodes", {"point": [60, -40, 25], "rings": 1}), engine)
    assert found is not None and found.startswith("the point (60, -40, 25) is ") and "scene" in found
    assert misplaced([{"point": ["a", 0, 0]}, 3, None, {"point": {}}], engine) is None
