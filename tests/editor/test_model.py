"""State of the editor: selection, handles, pins, time and undo."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest

from helpers.editor_models import LEFT, RIGHT, chosen, new_model
from scgs_warp.edit import EditSession, Film, Playback, Target
from scgs_warp.edit.handles import STAY
from scgs_warp.edit.rotations import from_axis
from scgs_warp.editor.gizmo_pose import GizmoFrame
from scgs_warp.editor.model import EditorModel, Moment
from scgs_warp.errors import UserError
from scgs_warp.geometry.normalisation import Normalisation


@pytest.fixture
def model() -> EditorModel:
    return new_model()


def test_selections_replace_add_and_subtract(model):
    model.select((3, 1))
    model.select((5,), "add")
    assert model.selection == (1, 3, 5)
    model.select((3, 9), "subtract")
    assert model.selection == (1, 5)
    model.select((2,))
    assert model.selection == (2,)


def test_a_new_brush_has_the_size_of_the_scene(model):
    """0.1, whatever the units, covered nothing of a scene in millimetres, and all of one that is small."""
    near = model.session.within(RIGHT, model.region.radius, 0.0)
    assert 1 < len(near) < len(model.session) / 2
    scene = copy.copy(model.session.scene)
    scene.normalisation = Normalisation(scene.normalisation.centre * 1e3, scene.normalisation.scale / 1e3)
    larger = EditorModel(EditSession(scene))
    assert larger.region.radius == pytest.approx(1e3 * model.region.radius)
    assert larger.session.within(1e3 * np.array(RIGHT), larger.region.radius, 0.0) == near


def test_a_drag_is_one_step(model):
    model.select(chosen(model))
    name = model.grab(STAY)
    for z in (0.1, 0.2, 0.3):
        assert model.moment().live
        model.drag(Target((0.0, 0.0, z)))
    model.release()
    assert not model.moment().live and model.session.edit.targets[name].translation == (0, 0, 0.3)
    assert model.active == name and model.session.edit.handle(name).nodes == model.selection
    assert model.undo()
    assert not model.session.edit.handles and model.active is None and model.selection
    assert not model.undo() and model.redo()
    assert model.session.edit.targets[name].translation == (0, 0, 0.3)


def test_without_a_selection_nothing_is_held(model):
    with pytest.raises(UserError, match="nothing is chosen"):
        model.grab(STAY)
    assert not model.dragging and not model.session.edit.handles and not model.undo()


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_a_broken_number_changes_nothing(model, broken):
    model.select(chosen(model))
    model.grab(STAY)
    model.drag(Target((0.1, 0.0, 0.0)))
    before = model.session.edit
    with pytest.raises(UserError, match="translation"):
        GizmoFrame(np.zeros(3), np.array([1.0, 0, 0, 0])).target(np.array([broken, 0, 0]), np.array([1.0, 0, 0, 0]))
    with pytest.raises(UserError, match="translation"):
        model.drag(Target((broken, 0.0, 0.0)))
    assert model.session.edit is before and model.dragging


def test_a_kilometre_is_survived(model):
    model.select(chosen(model))
    model.pin_rings = 1
    model.grab(STAY)
    model.drag(Target((0.0, 0.0, 1000.0)))
    for live in (True, False):
        points = model.session.node_positions(0.0, live=live)
        assert np.isfinite(points).all()
    model.release()
    assert float(model.session.node_positions(0.0)[list(model.selection), 2].min()) > 999
    assert model.undo() and np.abs(model.session.node_positions(0.0)).max() < 10


def test_pinning_the_rest_makes_way_for_the_next_handle(model):
    model.pin_rings = 1
    model.select(chosen(model, RIGHT, 0))
    model.grab(STAY)
    model.drag(STAY)
    model.release()
    session = model.session
    assert set(session.edit.pins) == set(range(len(session))) - set(session.ring(model.selection, 1))
    model.select(chosen(model, LEFT, 0))
    model.grab(STAY)
    model.drag(STAY)
    model.release()
    near = set(session.ring(session.edit.handles[0].nodes, 1)) | set(session.ring(session.edit.handles[1].nodes, 1))
    assert set(session.edit.pins) == set(range(len(session))) - near
    with model.changing():
        session.pin([session.ring(model.selection, 1)[0]])
    own = session.edit.pins
    model.select(tuple(sorted({*chosen(model, (0.5, -1.0, 0.25), 0), own[0]})))
    model.grab(STAY)
    model.drag(STAY)
    model.release()
    assert set(session.edit.pins) == set(own) - set(model.selection), "what the user pinned stays, but for the handle"


def test_keyframes_lead_until_a_drag_begins(model):
    model.replace(film=Film(seconds=2.0, fps=10))
    model.select(chosen(model))
    name = model.grab(STAY)
    model.drag(STAY)
    model.release()
    model.add_keyframe()
    model.look(2.0)
    model.grab(STAY)
    model.drag(Target((0.0, 0.0, 1.0)))
    model.release()
    model.add_keyframe("linear")
    assert [frame.at for frame in model.session.edit.keyframes] == [0.0, 2.0]
    model.look(1.0)
    moment = model.moment()
    height = model.session.engine.targets(model.session.edit, moment.at)[name].translation[2]
    assert moment.at == 1.0 and 0.3 < height < 0.7
    model.grab(STAY)
    assert model.session.edit.targets[name].translation[2] == height, "the drag goes on from where it is seen"
    assert model.moment().at is None
    model.release()
    model.add_keyframe()
    assert len(model.session.edit.keyframes) == 3 and model.moment().at == 1.0


def test_the_moment_stays_within_the_film(model):
    model.replace(film=Film(seconds=2.0, fps=10))
    model.look(0.2)
    for broken in (math.nan, math.inf):
        model.look(broken)
        assert model.at == 0.2
    model.look(-1.0)
    assert model.at == 0.0
    model.look(1e9)
    assert model.at == 2.0
    model.replace(film=Film(seconds=1.0))
    assert model.at == 1.0


def test_handles_are_changed_reset_and_removed(model):
    with pytest.raises(UserError, match="no handle"):
        model.change_handle(lasts="frame")
    with pytest.raises(UserError, match="no handle"):
        model.remove_handle()
    model.select(chosen(model))
    name = model.grab(STAY)
    model.drag(STAY)
    model.release()
    model.change_handle(lasts="fade", window=0.3)
    assert model.session.edit.handle(name).lasts == "fade"
    model.remove_handle()
    assert model.active is None and not model.session.edit.handles
    model.undo()
    model.reset()
    assert not model.session.edit.handles and not model.session.edit.pins


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"film": 3}, "film"),
        ({"pins": [10**6]}, "pins"),
        ({"targets": {"nobody": Target()}}, "targets.nobody"),
        ({"skin": "fur"}, "skin"),
    ],
)
def test_what_a_page_sends_is_checked(model, fields, words):
    before = model.session.edit
    with pytest.raises(UserError, match=words):
        model.replace(**fields)
    model.select(chosen(model))
    model.grab(STAY)
    model.drag(STAY)
    model.release()
    with pytest.raises(UserError, match="lasts"):
        model.change_handle(lasts="for ever")
    assert model.undo() and model.session.edit == before


def hold(model: EditorModel, point=RIGHT, rings: int = 0) -> str:
    model.select(chosen(model, point, rings))
    name = model.grab(STAY)
    model.drag(Target((0.0, 0.0, 0.05)))
    model.release()
    return name


def test_pins_that_nobody_asked_for_go_with_their_handle(model):
    model.pin_rings = 2
    hold(model)
    assert model.session.edit.pins
    model.remove_handle()
    assert not model.session.edit.pins
    assert model.undo() and model.session.edit.handles and model.session.edit.pins, "one step"
    model.remove_handle()
    with model.changing() as session:
        session.pin([0, 1])
    hold(model)
    assert set(model.session.edit.pins) == {0, 1} - set(model.selection)
    model.remove_handle()
    assert model.session.edit.pins, "these somebody asked for"


def test_pins_make_way_after_the_number_of_rings_has_changed(model):
    model.pin_rings = 1
    first = hold(model)
    model.pin_rings = 2
    second = hold(model, LEFT)
    session = model.session
    free = {n for name in (first, second) for n in session.ring(session.edit.handle(name).nodes, 2)}
    assert set(session.edit.pins) == set(range(len(session))) - free
    model.undo()
    model.pin_rings = 3
    third = hold(model, LEFT)
    assert not set(session.edit.pins) & set(session.ring(session.edit.handle(third).nodes, 3)), "after undo, too"


def test_what_was_not_moved_has_not_been_in_hand(model):
    model.pin_rings = 1
    before = model.session.edit
    model.select(chosen(model))
    model.grab(STAY)
    assert model.session.edit.handles and model.dragging
    model.release()
    assert model.session.edit is before and model.active is None and model.selection and not model.undo()
    model.grab(STAY)
    with pytest.raises(UserError, match="translation"):
        model.drag(Target((math.nan, 0.0, 0.0)))
    model.release()
    assert model.session.edit is before and not model.undo()
    model.grab(STAY)
    assert not model.undo() and model.session.edit is before and not model.dragging
    hold(model)
    model.add_keyframe()
    model.look(0.0)
    assert model.moment().at == 0.0
    edit = model.session.edit
    model.grab(STAY)
    model.release()
    assert model.session.edit is edit and model.moment().at == 0.0, "keyframes still lead"


def test_a_keyframe_is_one_step(model):
    model.replace(film=Film(seconds=2.0, fps=10))
    name = hold(model)
    model.add_keyframe()
    model.look(2.0)
    model.grab(STAY)
    model.drag(Target((0.0, 0.0, 1.0)))
    model.release()
    model.add_keyframe()
    model.look(1.0)
    before = model.session.edit
    model.add_keyframe()
    assert len(model.session.edit.keyframes) == 3
    assert model.undo() and model.session.edit == before and model.session.edit.targets[name].translation[2] == 1.0


def test_the_target_is_that_of_the_moment_shown(model):
    model.replace(film=Film(seconds=2.0, fps=10))
    hold(model)
    model.add_keyframe()
    model.look(2.0)
    model.grab(STAY)
    model.drag(Target((0.0, 0.0, 1.0), tuple(from_axis([0, 0, 1], 90).tolist())))
    model.release()
    model.add_keyframe()
    assert model.target.translation[2] == 1.0
    model.look(0.0)
    assert model.target == Target((0.0, 0.0, 0.05))
    model.look(1.0)
    assert 0.3 < model.target.translation[2] < 0.7
    model.select(())
    assert model.target == STAY


def test_a_moment_of_a_long_film_is_known_at_once(model, monkeypatch):
    """It is asked for under the lock that the server's loop takes: no step of the film is computed."""
    model.replace(film=Film(seconds=3600.0, fps=1000.0))
    monkeypatch.setattr(Playback, "times_at", None)
    monkeypatch.setattr(Playback, "time_at", lambda playback, at, seconds: 0.25)
    assert model.moment() == Moment(0.25, None, False)


def test_a_moment_shows_the_film_or_the_handles(model):
    assert model.moment() == Moment(0.0, None, False)


def test_what_one_frame_poses_is_moved_at_other_moments_too(model):
    """A drag of a handle that does not show at the moment would show nothing: another one is made on its points, and
    the frame keeps its pose."""
    session = model.session
    model.set(lasts="frame", pin_rings=None)
    model.select((3, 4, 5))
    for at, height in ((1.0, 0.2), (3.0, 0.4), (1.0, 0.3)):
        model.look(at)
        before = session.node_positions(model.time)
        model.grab(Target())
        model.drag(Target((0.0, 0.0, height)))
        model.release()
        moved = session.node_positions(model.time)[[3, 4, 5]] - before[[3, 4, 5]]
        assert np.abs(moved).max() > 0.05
    first, second = (session.edit.handle(name) for name in ("handle 1", "handle 2"))
    assert first is not None and second is not None and len(session.edit.handles) == 2
    assert second.nodes == first.nodes and first.time != second.time and model.active == "handle 1"
    assert session.edit.targets["handle 1"].translation[2] == 0.3
