"""The panel's controls without a browser: their effect on the edit, and their values."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import Edit, EditSession, Exaggerate, Film, Handle, Hold, Keyframe, Playback, Target
from scgs_warp.edit.handles import STAY
from scgs_warp.edit.rotations import from_axis
from scgs_warp.editor.app import Editor
from scgs_warp.editor.panel.shape import NEW
from scgs_warp.errors import UserError

pytest.importorskip("viser", reason="the editor needs viser: pip install 'scgs_warp[edit]'")


@pytest.fixture
def editor(tmp_path) -> Iterator[Editor]:
    made = Editor(EditSession(bar_scene()), tmp_path, port=0)
    yield made
    made.stop()


def test_what_is_selected_is_held_once_and_let_go(editor):
    model, motion = editor.model, editor.panel.motion
    with pytest.raises(UserError, match="nothing is chosen"):
        motion.hold_selection()
    model.seek(1.0)
    model.select((3, 1))
    motion.hold_selection()
    motion.frame.value, motion.rings.value = "world", 4
    motion.hold_selection()
    assert model.session.edit.holds == (Hold((1, 3), model.time, "world", 4),)  # the same region again: one hold
    editor.panel.show()
    assert motion.chosen.value == "hold 1" and f"| 2 | {model.time:.2f} | world |" in motion.list.content
    model.select((5,))
    motion.hold_selection()
    motion.select_hold("hold 1")
    assert model.selection == (1, 3)
    editor.panel.show()
    motion.release_hold()
    assert [hold.nodes for hold in model.session.edit.holds] == [(5,)]
    model.undo()
    assert len(model.session.edit.holds) == 2
    motion.chosen.value = "none"
    with pytest.raises(UserError, match="no hold is chosen"):
        motion.release_hold()


def test_motion_is_exaggerated_for_some_or_all_about_a_pose(editor):
    model, motion = editor.model, editor.panel.motion
    motion.exaggerate(factor=2.0)
    assert model.session.edit.exaggerate == Exaggerate(2.0)
    model.seek(1.0)
    motion.set_reference("This moment")
    assert model.session.edit.exaggerate == Exaggerate(2.0, model.time)
    with pytest.raises(UserError, match="nothing is chosen"):
        motion.set_extent("Only selection")
    model.select((2, 4))
    motion.set_extent("Only selection")
    assert model.session.edit.exaggerate == Exaggerate(2.0, model.time, (2, 4))
    editor.panel.show()
    assert motion.factor.value == 2.0 and "2 control points" in motion.extent.content
    motion.set_extent("All")
    motion.set_reference("Mean pose")
    assert model.session.edit.exaggerate == Exaggerate(2.0)
    with pytest.raises(UserError, match="factor"):
        motion.exaggerate(factor=float("nan"))
    motion.set_extent("Off")
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


def opened(tmp_path, edit: Edit) -> Editor:
    session = EditSession(bar_scene())
    session.apply(edit)
    return Editor(session, tmp_path, port=0)


@pytest.mark.parametrize("film", [Film(seconds=0.001, fps=0.01), Film(seconds=0.01), Film(fps=0.5), Film(3600, 1000)])
def test_films_that_the_panel_would_not_offer_are_shown(tmp_path, film):
    editor = opened(tmp_path, Edit(film=film, playback=Playback(speed=-1000.0)))
    try:
        editor.panel.show()
        shown = editor.panel.film
        assert (shown.seconds.value, shown.fps.value, shown.speed.value) == (film.seconds, film.fps, -1000.0)
        assert shown.seconds.min <= film.seconds <= shown.seconds.max and shown.fps.min <= film.fps <= shown.fps.max
    finally:
        editor.stop()


def test_numbers_are_those_of_the_moment_shown(editor):
    """What one types in goes on from what one sees."""
    model, shape = editor.model, editor.panel.shape
    model.replace(film=Film(seconds=2.0, fps=10))
    model.select((3, 4, 5))
    editor.put(STAY)
    model.add_keyframe()
    model.seek(2.0)
    editor.put(Target.of((0.0, 0.0, 0.2), from_axis([0, 0, 1], 90).tolist()))
    model.add_keyframe()
    editor.panel.show()
    assert shape.turn.value == pytest.approx((0, 0, 90)) and shape.move.value == (0.0, 0.0, 0.2)
    model.seek(0.0)
    editor.panel.show_time()
    assert shape.turn.value == (0.0, 0.0, 0.0) and shape.move.value == (0.0, 0.0, 0.0)
    shape.move_handle((0.0, 0.1, 0.0))
    assert model.session.edit.targets["handle 1"] == Target((0.0, 0.1, 0.0))


@pytest.mark.parametrize("show", ["original", "side by side"])
def test_numbers_move_the_handle_whatever_is_shown(editor, show):
    model = editor.model
    with pytest.raises(UserError, match="nothing is chosen"):
        editor.put(STAY)
    model.select((3, 4, 5))
    editor.put(Target((0.1, 0.0, 0.0)))
    model.set(show=show)
    editor.gizmo_frame = None  # no gizmo is shown there
    editor.panel.shape.move_handle((0.0, 0.2, 0.0))
    assert model.session.edit.targets["handle 1"].translation == (0.0, 0.2, 0.0)


def test_a_refused_number_leaves_nothing(editor):
    editor.model.select((3, 4, 5))
    with pytest.raises(UserError, match="finite"):
        editor.put(Target((math.nan, 0.0, 0.0)))
    assert editor.model.session.edit == Edit() and not editor.model.undo()


def test_every_handle_and_keyframe_can_be_chosen(tmp_path):
    handles = Handle(NEW, (1,)), Handle(f"{NEW} (handle)", (2,)), Handle("a", (3,))
    frames = tuple(Keyframe(at, {"a": STAY}) for at in (0.5, 0.5001, 0.5002, 1.0))
    editor = opened(tmp_path, Edit(handles=handles, keyframes=frames))
    try:
        model, shape, film = editor.model, editor.panel.shape, editor.panel.film
        assert len(set(shape.handle.options)) == 4 and shape.handle.options[0] == NEW
        assert sorted(name for name in shape.handle_labels().values() if name) == sorted(
            handle.name for handle in handles
        )
        for label, name in shape.handle_labels().items():
            model.activate(name)
            model.selection = () if name is None else model.selection
            editor.panel.show()
            assert shape.handle.value == label
        for label in film.chosen.options[1:]:
            film.seek_keyframe(label)
            editor.panel.show()
            assert film.chosen.value == label
        assert (
            sorted(film.keyframe_labels().values()) == [0.5, 0.5001, 0.5002, 1.0] and "1.000 s" in film.chosen.options
        )
    finally:
        editor.stop()


def test_files_are_not_replaced_unless_asked_for(editor):
    panel = editor.panel.files
    assert [panel.save().name for _ in range(3)] == ["edit.json", "edit 2.json", "edit 3.json"]
    editor.panel.show()
    assert panel.saved.options == ("edit 2.json", "edit 3.json", "edit.json")
    panel.replace.value = True
    assert panel.save().name == "edit.json"
    panel.load("edit 2.json")
