"""Editing sessions: unchanged bits, history, and mistakes of users."""

from __future__ import annotations

import copy
import dataclasses
import math
import pickle
from typing import Any

import numpy as np
import pytest
import torch

from helpers.edit_scenes import OVERVIEW, bar_scene
from helpers.edit_sessions import ends, same
from scgs_warp.edit import Edit, EditSession, Exaggerate, Hold
from scgs_warp.edit.rotations import from_axis, rotate
from scgs_warp.edit.session import HISTORY
from scgs_warp.errors import UserError
from scgs_warp.geometry import cameras
from scgs_warp.runtime import environment

CAMERA = cameras.orbit_camera(dataclasses.replace(OVERVIEW, centre=(0.5, -1.0, 0.25), radius=2.0), 20.0, 48)


TURN = from_axis([0, 0, 1], 40).tolist()


@pytest.fixture
def session() -> EditSession:
    return EditSession(bar_scene())


@pytest.fixture
def bent(session: EditSession) -> EditSession:
    left, right = ends(session)
    session.add_handle(right, 0.0, "right")
    session.pin(left)
    session.move("right", [0.0, 0.1, 0.0], TURN)
    return session


@pytest.mark.parametrize("shaded", [False, True])
def test_no_edit_has_the_scenes_bits(shaded):
    scene = bar_scene(shaded=shaded)
    session = EditSession(scene)
    for time in (0.0, 0.37, 1.0):
        assert same(session.gaussians_at(time), scene.gaussians_at(time))
        assert same(session.render(CAMERA, time), scene.render(CAMERA, time))
    session.add_handle([3, 4, 5], 0.2)
    session.pin([10, 11])
    session.add_keyframe(1.0)
    assert same(session.gaussians_at(0.5, 0.7), scene.gaussians_at(0.5)), "handles that stay are no edit"
    assert same(session.render(CAMERA, 0.5, live=True), scene.render(CAMERA, 0.5))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda session: pickle.loads(pickle.dumps(session))])
def test_a_copy_draws_the_same_and_is_edited_alone(bent, copied):
    before, edit = bent.gaussians_at(0.3), bent.edit
    other = copied(bent)
    assert same(other.gaussians_at(0.3), before) and same(other.gaussians_at(0.6), bent.gaussians_at(0.6))
    other.move("right", [0.0, 0.3, 0.0])
    assert bent.edit is edit and same(bent.gaussians_at(0.3), before) and not same(other.gaussians_at(0.3), before)


def test_what_is_pinned_keeps_its_bits_and_the_handle_goes_where_it_is_put(bent):
    before, after = bent.scene.gaussians_at(0.0), bent.gaussians_at(0.0)
    held = torch.isin(bent.engine.binding[0].long(), torch.tensor(bent.edit.pins)).all(1)
    assert int(held.sum()) > 20
    for name, value in before.tensors().items():
        assert torch.equal(value[held], getattr(after, name)[held]), name
    handle = bent.edit.handles[0]
    start = bent.engine.to_world(bent.engine.motion_at(0.0).positions)[list(handle.nodes)]
    pivot = bent.pivot("right")
    np.testing.assert_allclose(pivot, start.mean(0))
    expected = rotate(np.array(TURN), start - pivot) + pivot + [0.0, 0.1, 0.0]
    np.testing.assert_allclose(bent.node_positions(0.0)[list(handle.nodes)], expected, atol=1e-9)


def test_colours_turn_with_the_edit_alone(bent):
    """Degree 0 and shading stay; a rigidly moved Gaussian shows the same colour from the side that it now faces."""
    scene = bar_scene(shaded=True)
    session = EditSession(scene)
    session.add_handle(range(len(session)), 0.6, "all")
    session.move("all", [0.3, -0.2, 0.1], TURN)
    before, after = scene.gaussians_at(0.6), session.gaussians_at(0.6)
    assert not torch.equal(before.sh_rest, after.sh_rest)
    torch.testing.assert_close(after.sh_dc, before.sh_dc, rtol=0, atol=1e-6)
    turn = torch.eye(4, dtype=torch.float64)
    from scgs_warp.edit.rotations import to_matrix

    R = torch.from_numpy(to_matrix(np.array(TURN)))
    pivot = torch.from_numpy(session.pivot("all"))
    turn[:3, :3], turn[:3, 3] = R, pivot - R @ pivot + torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    moved = dataclasses.replace(CAMERA, viewmat=(CAMERA.viewmat.double() @ torch.linalg.inv(turn)).float())
    difference = (scene.render(CAMERA, 0.6).rgb - session.render(moved, 0.6).rgb).abs()
    assert float((difference < 2e-3).double().mean()) > 0.998
    assert float(scene.render(CAMERA, 0.6).alpha.mean()) > 0.03


def test_an_edit_is_carried_along_the_motion(bent):
    """At time 1 the right end has swung by 60 degrees: the edit made at 0 has swung with it."""
    right = list(bent.edit.handles[0].nodes)
    start = bent.engine.to_world(bent.engine.motion_at(0.0).positions)
    for time in (0.5, 1.0):
        then = bent.engine.to_world(bent.engine.motion_at(time).positions)
        swing = from_axis([0, 1, 0], 60 * time)
        centre = np.array([0.5, -1.0, 0.25])
        far = [n for n in right if start[n, 0] > centre[0] + 0.26]
        np.testing.assert_allclose(then[far], rotate(swing, start[far] - centre) + centre, atol=1e-6)
        edited = bent.node_positions(0.0)
        expected = rotate(swing, edited[far] - centre) + centre
        np.testing.assert_allclose(bent.node_positions(time)[far], expected, atol=2e-3)
        assert np.abs(bent.node_positions(time) - then)[right].max() > 0.05


@pytest.mark.parametrize("lasts", ["frame", "fade"])
def test_edits_that_do_not_last(session, lasts):
    left, right = ends(session)
    session.add_handle(right, 0.4, "right", lasts=lasts, window=0.2)
    session.pin(left)
    session.move("right", None, TURN)

    def moved(time: float) -> float:
        motion = session.engine.to_world(session.engine.motion_at(time).positions)
        return float(np.abs(session.node_positions(time) - motion).max())

    assert moved(0.4) > 0.09 and moved(0.0) == 0.0 and moved(0.61) == 0.0
    if lasts == "frame":
        assert moved(0.42) == 0.0
        near = session.gaussians_at(0.42, frame=0.03)
        assert not same(near, session.scene.gaussians_at(0.42))
    else:
        assert moved(0.4) > moved(0.5) > moved(0.58) > 0.0
        assert moved(0.599) < 1e-3


def test_a_drag_is_fast_to_look_at_and_settles_to_the_same(bent):
    steps = np.linspace(40, 80, 9)
    for degrees in steps:
        bent.drag("right", rotation=from_axis([0, 0, 1], degrees))
        live = bent.node_positions(0.0, live=True)
    while not bent.engine.settled(bent.edit):
        live = bent.node_positions(0.0, live=True)
    for _ in range(20):
        live = bent.node_positions(0.0, live=True)
    bent.release()
    np.testing.assert_allclose(live, bent.node_positions(0.0), atol=1e-3)
    assert bent.undo() and bent.edit.targets["right"].rotation == tuple(TURN), "a drag is one step"


def test_results_do_not_depend_on_the_way(bent):
    there = bent.node_positions(0.0).tobytes()
    other = EditSession(bar_scene())
    other.apply(bent.edit)
    for degrees in (10, 170, -60):
        other.drag("right", rotation=from_axis([1, 0, 0], degrees))
        other.node_positions(0.3, live=True)
    other.release()
    other.undo()
    other.node_positions(0.7)
    assert other.edit == bent.edit
    assert other.node_positions(0.0).tobytes() == there


def test_a_new_edit_ends_what_could_be_redone(session):
    session.pin([5])
    session.undo()
    assert session.can_redo
    session.pin([6])
    assert not session.can_redo and not session.redo() and session.edit.pins == (6,)


def test_an_edit_that_changes_nothing_is_no_step(session):
    session.pin([5])
    session.undo()
    session.apply(session.edit)
    assert not session.can_undo and session.can_redo, "nothing to undo, and the undone step can still be redone"


def test_undo_and_redo(session):
    empty = session.edit
    assert not session.undo() and not session.redo()
    session.add_handle([1, 2], 0.0, "a")
    session.move("a", [1.0, 0, 0])
    session.pin([5])
    pinned = session.edit
    assert session.undo() and session.undo() and session.undo() and session.edit == empty
    assert session.redo() and session.redo() and session.redo() and session.edit == pinned and not session.redo()
    session.undo()
    session.unpin()
    session.reset()
    assert session.edit == empty and session.undo() and session.edit.handles
    session.remove_handle("a")
    assert not session.edit.handles and not session.edit.targets


def test_save_and_load_give_the_same_bits(bent, tmp_path):
    bent.add_keyframe(0.0)
    bent.drag("right", [0.1, 1 / 3, math.pi], from_axis([1, 2, 3], 77.7))
    bent.add_keyframe(1.5, "ease")
    changed = dataclasses.replace(bent.edit, holds=(Hold((0, 1, 2), 0.25),), exaggerate=Exaggerate(1.25))
    bent.apply(changed)
    bent.save(tmp_path / "new" / "folder" / "edit.json")
    bent.save(tmp_path / "edit.json")
    assert (tmp_path / "new/folder/edit.json").read_bytes() == (tmp_path / "edit.json").read_bytes()
    first = bent.render(CAMERA, 0.3, 0.9)
    other = EditSession(bar_scene())
    other.load(tmp_path / "edit.json")
    assert other.edit == bent.edit
    assert same(other.render(CAMERA, 0.3, 0.9), first) and same(other.gaussians_at(0.8), bent.gaussians_at(0.8))
    other.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "edit.json").read_bytes()


def test_same_bits_on_any_number_of_threads(bent, all_threads):
    results = []
    for threads in (1, 2):
        environment.configure(threads=threads)
        other = EditSession(bar_scene())
        other.apply(bent.edit)
        results.append(other.render(CAMERA, 0.4))
    assert same(*results)


def test_degenerate_edits_have_a_result(session):
    """No handle, one, all pinned, two handles on one node, a soft one alone, a drag of a kilometre."""
    session.pin(range(len(session)))
    assert same(session.gaussians_at(0.1), session.scene.gaussians_at(0.1))
    session.add_handle([4], 0.0, "one")
    session.add_handle([4, 5], 0.0, "two")
    session.move("one", [1.0, 0, 0])
    session.move("two", [0, 0.5, 0])
    start = session.engine.to_world(session.engine.motion_at(0.0).positions)
    np.testing.assert_allclose(session.node_positions(0.0)[4], start[4] + [0, 0.5, 0], atol=1e-9)
    session.unpin()
    session.move("two", [1000.0, 0, 0], from_axis([1, 0, 0], 180))
    assert np.isfinite(session.node_positions(0.5)).all()
    assert torch.isfinite(session.gaussians_at(0.5).means).all()
    assert torch.isfinite(session.render(CAMERA, 0.5).rgb).all()
    assert np.isfinite(session.node_positions(0.5, live=True)).all()
    session.reset()
    session.add_handle([7], 0.0, "soft", stiffness=0.1)
    session.move("soft", [0.2, 0, 0])
    np.testing.assert_allclose(session.node_positions(0.0) - start, np.tile([0.2, 0, 0], (len(start), 1)), atol=1e-3)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_drag_that_is_no_number_is_refused_in_one_line(bent, bad):
    edit = bent.edit
    for arguments in (([bad, 0, 0], None), (None, [bad, 0, 0, 1]), ([1, 2], None), (None, [0, 0, 0, 0])):
        with pytest.raises(UserError) as caught:
            bent.drag("right", *arguments)
        assert "\n" not in str(caught.value)
        assert bent.edit == edit
    with pytest.raises(UserError, match="time"):
        bent.node_positions(bad)


def test_mistakes_are_one_line(session):
    for make, words in [
        (lambda: session.add_handle([], 0.0), "at least one"),
        (lambda: session.add_handle([99], 0.0), "99"),
        (lambda: session.add_handle([-1], 0.0), "-1"),
        (lambda: session.add_handle([1], 2.0), "time"),
        (lambda: session.add_handle([1], 0.0, stiffness=-1.0), "stiffness"),
        (lambda: session.add_handle([1], 0.0, pivot=(math.nan, 0.0, 0.0)), "pivot"),
        (lambda: session.drag("nobody", [1, 0, 0]), "nobody"),
        (lambda: session.add_keyframe(1.0), "handle"),
        (lambda: session.save("/dev/null/edit.json"), "/dev/null"),
        (lambda: session.save(""), "is no file name"),
        *((lambda edit=edit: session.apply(edit), "edit is .*give a scgs_warp.edit.Edit") for edit in (None, {}, "x")),
        (lambda: session.preview({}), "edit is {}"),
        (lambda: EditSession(session.scene, {}), "edit is {}"),
        (lambda: EditSession("runs/figure-quick"), "scene is 'runs/figure-quick'; give a scgs_warp.Scene"),
        (lambda: session.pick(CAMERA, math.nan, 3, 0.0), "pixel is nan"),
        (lambda: session.pick(CAMERA, 3, None, 0.0), "pixel is None"),
        *((lambda count=count: session.parts(count), "parts: count is") for count in (0, -1, 2.5, "3", True)),
    ]:
        with pytest.raises(UserError, match=words) as caught:
            make()
        assert "\n" not in str(caught.value)
    assert session.edit == Edit()


@pytest.mark.parametrize("bad", ["x", [], None, math.nan, {}])
def test_numbers_of_another_kind_are_named(session, bad):
    for make, words in [
        (lambda: session.ring([1], bad), "count must be a whole number"),
        (lambda: session.within((0, 0, 0), bad, 0.0), "radius must be a number"),
        (lambda: session.pin_rest(bad), "rings must be a whole number"),
        *([] if bad is None else [(lambda: session.node_positions(0.0, frame=bad), "frame must be a number")]),
    ]:
        with pytest.raises(ValueError, match=words):
            make()


def test_a_handle_is_renamed_in_targets_and_keyframes(session):
    nodes = ends(session)[0]
    session.add_handle(nodes, 0.0, "hand")
    session.add_handle([nodes[0]], 0.0, "finger")
    session.move("hand", (0.0, 0.1, 0.0))
    session.add_keyframe(1.0)
    before, targets = session.edit, session.engine.targets(session.edit, 1.0)
    session.rename_handle("hand", "left hand")
    renamed = {{"hand": "left hand"}.get(name, name): target for name, target in targets.items()}
    assert session.engine.targets(session.edit, 1.0) == renamed
    assert [handle.name for handle in session.edit.handles] == ["left hand", "finger"]
    assert session.edit.handles[0].nodes == tuple(sorted(nodes))
    assert session.undo() and session.edit == before
    for old, new, words in (("hand", "finger", "is taken"), ("nobody", "x", "no handle"), ("hand", "", "give a name")):
        with pytest.raises(UserError, match=words):
            session.rename_handle(old, new)
    assert session.edit == before


def test_choosing(session):
    positions = session.node_positions(0.2)
    assert session.nearest(positions[17] + 1e-4, 0.2) == 17
    assert set(session.within(positions[17], 0.1, 0.2)) == set(
        np.flatnonzero(np.linalg.norm(positions - positions[17], axis=1) <= 0.1)
    )
    assert 17 in session.ring([17], 2) and len(session.ring([17], 2)) > len(session.ring([17], 1)) > 3
    image = session.render(CAMERA, 0.0)
    row, column = (int(i) for i in np.argwhere(image.alpha.numpy() > 0.9)[0])
    point = session.pick(CAMERA, column + 0.5, row + 0.5, 0.0)
    assert point is not None and np.abs(session.node_positions(0.0) - point).max(1).min() < 0.2
    assert session.pick(CAMERA, 0.5, 0.5, 0.0) is None and session.pick(CAMERA, -3, 900, 0.0) is None
    session.add_handle([17], 0.0)
    session.pin_rest(1)
    assert set(session.edit.pins) == set(range(len(session))) - set(session.ring([17], 1))


def test_a_name_that_is_taken_is_taken_over_at_rest(bent):
    bent.add_keyframe(0.0)
    bent.add_handle([1, 2], 0.0, "right")
    assert not bent.edit.targets and not bent.edit.keyframes and len(bent.edit.handles) == 1
    assert same(bent.gaussians_at(0.0), bent.scene.gaussians_at(0.0))
    assert bent.undo() and bent.edit.keyframes and bent.edit.targets, "one step"


def test_saving_does_not_end_a_drag(bent, tmp_path):
    before = bent.edit
    bent.drag("right", [0.2, 0.0, 0.0])
    bent.save(tmp_path / "edit.json")
    bent.drag("right", [0.3, 0.0, 0.0])
    bent.release()
    assert bent.undo() and bent.edit == before
    bent.load(tmp_path / "edit.json")
    assert bent.edit.targets["right"].translation == (0.2, 0.0, 0.0)


def test_history_has_an_end(session, monkeypatch):
    """Whoever edits for days can undo the last thousand steps; what is older is forgotten."""
    fresh = session.fork()
    for count in range(HISTORY + 5):
        fresh.apply(dataclasses.replace(fresh.edit, pins=(count % 50,)))
    undone = 0
    while fresh.undo():
        undone += 1
    assert undone == HISTORY and fresh.edit.pins == (4,)


def test_control_points_are_whole_numbers_or_a_mask_of_all():
    session = EditSession(bar_scene())
    mask = np.zeros(len(session), bool)
    mask[[3, 5]] = True
    takes: list[Any] = [[5, 3], mask, mask.tolist(), torch.from_numpy(mask), np.array([3, 5], np.int32), {3, 5}]
    for nodes in takes:
        assert session.ring(nodes, 0) == (3, 5)
    session.pin(mask)
    assert session.edit.pins == (3, 5)
    refused: list[Any] = [[3.7], "12", [True, 1], mask[:-1], np.array([1.0]), [None], [len(session)], [-1]]
    for wrong in refused:
        with pytest.raises(UserError, match="control point"):
            session.add_handle(wrong, 0.0)
    with pytest.raises(UserError, match="control point"):
        session.split_part(session.skeleton.names[0], refused[0])
    assert not session.edit.handles


def test_a_handle_of_a_part_is_left_to_pose_part(session):
    with pytest.raises(UserError, match="pose_part"):
        session.add_handle([0, 1], 0.0, part=session.skeleton.names[0])
    assert session.edit == Edit()
