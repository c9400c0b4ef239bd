"""The panel's controls without a browser: what they do to the edit, and that they say what the edit is."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from edit_scenes import bar_scene

from scgs_warp.edit import EditSession
from scgs_warp.edit.playback import Exaggerate, Hold
from scgs_warp.errors import UserError

pytest.importorskip("viser", reason="the editor needs viser: pip install 'scgs_warp[edit]'")

from scgs_warp.editor.app import Editor


@pytest.fixture
def editor(tmp_path) -> Iterator[Editor]:
    made = Editor(EditSession(bar_scene()), tmp_path, port=0)
    yield made
    made.stop()


def test_what_is_selected_is_held_once_and_let_go(editor):
    model, motion = editor.model, editor.panel.motion
    with pytest.raises(UserError, match="nothing is chosen"):
        motion._hold()
    model.seek(1.0)
    model.select((3, 1))
    motion._hold()
    motion.frame.value, motion.rings.value = "world", 4
    motion._hold()
    assert model.session.edit.holds == (Hold((1, 3), model.time, "world", 4),)  # the same region again: one hold
    editor.panel.show()
    assert motion.chosen.value == "hold 1" and f"| 2 | {model.time:.2f} | world |" in motion.list.content
    model.select((5,))
    motion._hold()
    motion._select("hold 1")
    assert model.selection == (1, 3)
    editor.panel.show()
    motion._release()
    assert [hold.nodes for hold in model.session.edit.holds] == [(5,)]
    model.undo()
    assert len(model.session.edit.holds) == 2
    motion.chosen.value = "none"
    with pytest.raises(UserError, match="no hold is chosen"):
        motion._release()


def test_motion_is_exaggerated_for_some_or_all_about_a_pose(editor):
    model, motion = editor.model, editor.panel.motion
    motion._exaggerate(factor=2.0)
    assert model.session.edit.exaggerate == Exaggerate(2.0)
    model.seek(1.0)
    motion._about("This moment")
    assert model.session.edit.exaggerate == Exaggerate(2.0, model.time)
    with pytest.raises(UserError, match="nothing is chosen"):
        motion._extent("Only selection")
    model.select((2, 4))
    motion._extent("Only selection")
    assert model.session.edit.exaggerate == Exaggerate(2.0, model.time, (2, 4))
    editor.panel.show()
    assert motion.factor.value == 2.0 and "2 control points" in motion.extent.content
    motion._extent("All")
    motion._about("Mean pose")
    assert model.session.edit.exaggerate == Exaggerate(2.0)
    with pytest.raises(UserError, match="factor"):
        motion._exaggerate(factor=float("nan"))
    motion._extent("Off")
    assert model.session.edit.exaggerate is None
    editor.panel.show()
    assert motion.factor.value == 1.0 and "Off" in motion.extent.content
    model.undo()
    assert model.session.edit.exaggerate == Exaggerate(2.0)


def test_a_file_that_exaggerates_more_than_the_slider_offers_is_shown(editor):
    editor.model.replace(exaggerate=Exaggerate(-5.0))
    editor.panel.show()
    assert editor.panel.motion.factor.value == -5.0
    editor.model.replace(exaggerate=Exaggerate(7.0))
    editor.panel.show()
    assert editor.panel.motion.factor.value == 7.0
