"""Parts in the editor: what clicks take, and what drags do with it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from helpers.edit_scenes import figure_scene
from scgs_warp.edit import EditSession, Film, Target
from scgs_warp.edit.rotations import from_axis, rigid_fit, rotate
from scgs_warp.edit.skeleton import Skeleton
from scgs_warp.editor.model import EditorModel, Region
from scgs_warp.editor.parts_tool import PartsTool, hit
from scgs_warp.errors import UserError

AWAY = np.array([0.05, -0.1, 0.2])
HAND, CHEST = np.array([0.55, -0.1, -0.2]), (0.0, -0.3, 0.2)


@pytest.fixture(scope="module")
def loaded() -> EditSession:
    return EditSession(figure_scene(256)[0])


@pytest.fixture
def model(loaded) -> EditorModel:
    return EditorModel(loaded.fork())


@pytest.fixture
def tool(model) -> PartsTool:
    return PartsTool(model)


def click(tool: PartsTool, point=HAND, how="replace", rings: int = 1) -> None:
    model = tool.model
    tool.click(hit(model.session, np.array(point), Region("rings", rings), model.moment()), how)


def carried(tool: PartsTool, before: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Return where the chosen part takes ``HAND`` when control points [M, 3] go from ``before`` to ``now``."""
    rows = list(tool.model.selection)
    turn, old, new = rigid_fit(before[rows], now[rows])
    return rotate(turn, HAND - old) + new


def test_a_click_takes_the_part_and_a_second_one_its_points(tool):
    model, session = tool.model, tool.model.session
    click(tool)
    arm = tool.part
    assert arm is not None and model.selection == session.skeleton.part(arm).nodes
    nearest = session.nearest(HAND, 0.0)
    assert session.part_at(HAND, 0.0) == arm and session.skeleton.owners()[nearest] == session.skeleton.names.index(arm)
    for rings in (1, 0):
        click(tool, rings=rings)
        assert tool.part is None and model.selection == session.ring([nearest], rings), "further clicks: points"
    click(tool, CHEST)
    assert tool.part not in (None, arm), "another part"
    tool.click(None)
    assert tool.part is None and model.selection == ()
    click(tool)
    assert tool.part == arm, "beside the scene, one begins anew"


def test_shift_and_the_switch_give_control_points(tool):
    model = tool.model
    click(tool, how="add")
    assert tool.part is None and 0 < len(model.selection) < 20
    before = model.selection
    tool.click(None, "add")
    assert model.selection == before
    tool.set(False)
    click(tool, CHEST)
    assert tool.part is None and len(model.selection) < 20


def test_a_scene_of_one_part_has_points_only(tool):
    session = tool.model.session
    nodes = tuple(range(len(session)))
    session.edit = dataclasses.replace(session.edit, skeleton=Skeleton(
        (dataclasses.replace(session.parts()[0], name="all", nodes=nodes, parent=None),)
    ))  # fmt: skip
    click(tool)
    assert tool.part is None and 0 < len(tool.model.selection) < 20


def test_a_drag_pulls_and_is_one_step(tool):
    model, session = tool.model, tool.model.session
    click(tool)
    start, before = session.node_positions(0.0), session.edit
    tool.grab()
    for share in (0.2, 0.5, 1.0):
        tool.pull(HAND + share * AWAY, HAND)
        assert model.moment().live
    tool.release()
    assert not model.moment().live and tool.part is not None
    once = session.fork()
    once.apply(before)
    once.pull(tool.part, (HAND + AWAY).tolist(), grip=list(HAND))
    assert once.edit == session.edit, "the way of the drag does not matter"
    after = carried(tool, start, session.node_positions(0.0))
    assert np.linalg.norm(after - HAND - AWAY) < 0.03
    assert model.active == session.edit.handles[0].name and session.edit.handles[0].part == tool.part
    assert model.undo() and session.edit == before and not model.undo()


def test_an_arc_turns_the_joint_as_it_is_seen(tool):
    """Below a turned upper arm, an arc turns the forearm about a direction of the world, and turns add up."""
    model, session = tool.model, tool.model.session
    click(tool)
    part = tool.part
    assert part is not None
    above = session.skeleton.part(part).parent
    session.turn(above, 60, (0, -1, 0))
    session.turn(part, 20, (1, 0, 0))
    before = session.edit
    joint, motion = session.joint_of(part, 0.0), session._motion_of(session.edit, part, 0.0, None)[0]
    tool.grab()
    quat = from_axis((0.3, 0.5, -0.8), 40)
    tool.turn(from_axis((0.3, 0.5, -0.8), 10))
    tool.turn(quat)
    tool.release()
    now = session._motion_of(session.edit, part, 0.0, None)[0]
    point = session.engine.motion_at(0.0).positions[session.skeleton.part(part).nodes[0]]
    units = session.engine.to_world
    wanted = rotate(quat, units(motion.apply(point)) - joint) + joint
    np.testing.assert_allclose(units(now.apply(point)), wanted, atol=1e-9)
    np.testing.assert_allclose(session.joint_of(part, 0.0), joint, atol=1e-9)
    assert model.undo() and session.edit == before


def test_an_arc_turns_a_part_about_another_point(tool):
    """Below a turned and shifted upper arm, all of the forearm moves about a point of the hand, at any time."""
    model, session = tool.model, tool.model.session
    click(tool)
    part = tool.part
    assert part is not None
    session.turn(session.skeleton.part(part).parent, 60, (0, -1, 0))
    session.turn(part, 20, (1, 0, 0))
    session.move(part, (0.02, 0.01, 0.0))
    model.look(1.3)
    before, time = session.edit, model.time
    motion = session._motion_of(before, part, time, None)[0]
    points = session.engine.motion_at(time).positions[list(session.skeleton.part(part).nodes)]
    seen = session.engine.to_world(motion.apply(points))
    quat, about = from_axis((0.3, 0.5, -0.8), 40), seen[0]
    tool.grab()
    tool.turn(from_axis((0.3, 0.5, -0.8), 10), about.tolist())
    tool.turn(quat, about.tolist())
    tool.release()
    now = session._motion_of(session.edit, part, time, None)[0]
    wanted = rotate(quat, seen - about) + about
    np.testing.assert_allclose(session.engine.to_world(now.apply(points)), wanted, atol=1e-9)
    assert model.undo() and session.edit == before


def test_a_drag_without_movement_changes_nothing(tool):
    click(tool)
    before = tool.model.session.edit
    tool.grab()
    assert tool.model.dragging
    tool.release()
    assert tool.model.session.edit == before and not tool.model.dragging and not tool.model.undo()


def test_a_drag_starts_where_keyframes_put_the_part(tool):
    model, session = tool.model, tool.model.session
    model.replace(film=Film(seconds=2.0, fps=10))
    click(tool)
    part, start = tool.part, session.node_positions(0.0)
    assert part is not None
    tool.put(Target.of(None, from_axis((0, -1, 0), 0)))
    model.add_keyframe()
    model.look(2.0)
    tool.put(Target.of(None, from_axis((0, -1, 0), 60)))
    model.add_keyframe("linear")
    model.look(1.0)
    point = carried(tool, start, session.node_positions(0.0, 1.0))
    tool.grab()
    tool.pull(point, point)
    tool.release()
    angle = math.degrees(2 * math.acos(session.edit.targets[part].rotation[0]))
    assert angle == pytest.approx(30, abs=1.0)
    assert [frame.at for frame in session.edit.keyframes] == [0.0, 1.0, 2.0], "the drag keys itself"
    assert model.undo() and not model.dragging


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_broken_numbers_leave_the_edit(tool, broken):
    with pytest.raises(UserError, match="no part is chosen"):
        tool.grab()
    click(tool)
    tool.grab()
    tool.pull(HAND + 0.1, HAND)
    before = tool.model.session.edit
    with pytest.raises(UserError, match="finite"):
        tool.pull(np.array([broken, 0, 0]), HAND)
    with pytest.raises(UserError, match="finite"):
        tool.turn(np.array([1.0, broken, 0, 0]))
    assert tool.model.session.edit is before
    tool.release()


def test_a_changed_skeleton_unchooses_the_part(tool):
    click(tool)
    part = tool.part
    assert part is not None
    with tool.model.changing() as session:
        session.merge_parts(session.skeleton.part(part).parent, part)
    assert tool.part is None
    assert tool.model.undo() and tool.part == part


def test_a_part_is_posed_in_one_frame_and_in_another(tool):
    """What is set before a part is pulled holds for the handles that the pull makes."""
    model, session = tool.model, tool.model.session
    model.set(lasts="frame")
    click(tool)
    for at in (1.0, 3.0):
        model.look(at)
        before = session.node_positions(model.time)
        tool.grab()
        grip = before[list(model.selection)].mean(0)
        tool.pull(grip + AWAY, grip)
        model.release()
        assert np.linalg.norm(session.node_positions(model.time) - before, axis=1).max() > 0.1
        own = session.edit.handle(model.active or "")
        assert own is not None and own.lasts == "frame" and own.time == model.time and own.part == tool.part
    assert {handle.lasts for handle in session.edit.handles} == {"frame"}
    unedited = session.engine.to_world(session.engine.motion_at(0.9).positions)
    np.testing.assert_array_equal(session.node_positions(0.9), unedited)
