"""Clicks and gizmo: from the picture to control points and targets, and back."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from helpers.editor_models import LEFT, chosen, new_model
from scgs_warp.edit import Target
from scgs_warp.edit.handles import STAY
from scgs_warp.edit.rotations import angle, from_axis, multiply
from scgs_warp.editor.gizmo_pose import frame_of_handle, frame_of_selection, region_at
from scgs_warp.editor.model import EditorModel, Region
from scgs_warp.geometry.cameras import orbit_camera


@pytest.fixture
def model() -> EditorModel:
    return new_model()


def test_clicks_meet_the_surface(model):
    session, moment = model.session, model.moment()
    camera = orbit_camera(session.scene.overview, 40.0, 96)
    solid = session.render(camera, moment.time).alpha >= 0.5
    rows, columns = np.nonzero(solid.numpy())
    middle = len(rows) // 2
    point = session.pick(camera, columns[middle] + 0.5, rows[middle] + 0.5, moment.time, moment.at)
    assert point is not None and np.linalg.norm(point - session.node_positions(0.0), axis=1).min() < 0.2
    for beside in ((0.5, 0.5), (-3.0, 700.0)):
        assert session.pick(camera, *beside, moment.time, moment.at) is None
    rings = region_at(session, point, Region("rings", 1), moment)
    assert rings == session.ring([session.nearest(point.tolist(), 0.0)], 1)
    assert len(region_at(session, point, Region("brush", radius=1e-6), moment)) == 1, "never none"
    assert len(region_at(session, point, Region("brush", radius=10.0), moment)) == len(session)


def test_a_handle_taken_from_bent_surroundings_leaves_them(model):
    model.select(chosen(model))
    model.grab(STAY)
    model.drag(Target((0.0, 0.2, 0.3), tuple(from_axis([0, 1, 0], 30).tolist())))
    model.release()
    session, at = model.session, model.moment()
    before = session.node_positions(0.0)
    other = tuple(sorted(set(session.ring(model.selection, 1)) - set(model.selection)))
    assert other
    place, target = frame_of_selection(session, other, at)
    position, _ = place.pose(target)
    assert position == pytest.approx(before[list(other)].mean(0), abs=1e-9)


def test_the_gizmo_says_what_the_target_says(model):
    model.select(chosen(model))
    model.grab(STAY)
    target = Target.of((0.1, -0.2, 0.3), from_axis([1, 2, 3], 50).tolist())
    model.drag(target)
    model.release()
    session = model.session
    for time in (0.0, 0.7):
        place = frame_of_handle(session, session.edit.handles[0], dataclasses.replace(model.moment(), time=time))
        back = place.target(*place.pose(target))
        assert back.translation == pytest.approx(target.translation, abs=1e-9)
        assert back.rotation == pytest.approx(target.rotation, abs=1e-9)
        where = session.node_positions(time)[list(model.selection)].mean(0)
        assert place.pose(target)[0] == pytest.approx(where, abs=5e-3), "it stands on what it holds"
    assert place.target(place.pivot, np.array([1.0, 1e-20, 0, 0])).is_identity, "noise is no rotation"


def test_an_arc_turns_a_free_handle_on_from_where_the_solver_put_it(model):
    model.session.pin(chosen(model, LEFT, 2))
    model.select(chosen(model))
    model.grab(STAY)
    model.drag(Target.of((0.0, 0.0, 0.25)))
    model.release()
    session, handle = model.session, model.session.edit.handles[0]
    for time in (0.0, 0.6):
        moment = dataclasses.replace(model.moment(), time=time)
        place, shifted = frame_of_handle(session, handle, moment), session.edit.targets[handle.name]
        position, wxyz = place.pose(shifted)
        assert angle(place.free_turn) > math.radians(5), "the solver turned it"
        assert wxyz == pytest.approx(session.rotation_of(handle.name, time), abs=1e-6)
        assert place.target(position + np.array([0.1, 0.0, 0.0]), wxyz).rotation == (1.0, 0.0, 0.0, 0.0), (
            "a shift leaves it free"
        )
    place = frame_of_handle(session, handle, model.moment())
    before = session.node_positions(0.0)
    arc = from_axis([1, 0, 0], 0.5)
    turned = place.target(place.pose(shifted)[0], multiply(arc, place.pose(shifted)[1]))
    model.grab(shifted)
    model.drag(turned)
    model.release()
    assert np.abs(session.node_positions(0.0) - before).max() < 0.02, "half a degree does not make it jump"
    assert frame_of_handle(session, handle, model.moment()).free_turn is None
