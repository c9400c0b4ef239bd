"""Motions of one body on another: what is taken from a scene and a file, and where limbs point afterwards."""

from __future__ import annotations

import copy
import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest

from helpers.gltf_files import bar, box
from scgs_warp.data.synthetic.figure_motion import bone_transforms
from scgs_warp.edit import EditSession, motion_of_gltf, motion_of_session, retarget
from scgs_warp.edit.body_motion import UP, BodyMotion
from scgs_warp.edit.playback import Playback
from scgs_warp.edit.retarget import match_names, read_match
from scgs_warp.edit.rotations import IDENTITY, from_axis, least_turn, multiply, rotate, to_matrix
from scgs_warp.errors import UserError

ARM = ("shoulder_left", "elbow_left")


def arm_motion(upper: float, lower: float, flip: bool = False) -> BodyMotion:
    """A trunk with an arm that points along x (``flip``: down) and swings about y, bends at the elbow, and walks."""
    out = np.array([0.0, 0.0, -1.0]) if flip else np.array([1.0, 0.0, 0.0])
    joints = np.array([[0.0, 0, 0], 0.5 * out, 1.5 * out, 1.7 * out])
    first, second = from_axis((0, 1, 0), upper), from_axis((0, 1, 0), upper + lower)
    turns = np.stack([np.tile(IDENTITY, (4, 1)), [IDENTITY, first, second, second]])
    shifts = np.zeros((2, 4, 3))
    shifts[1] = [0.2, -1.0, 0.0]
    names = ("torso", "Shoulder_Left", "elbow_left", "hand")
    return BodyMotion(names, (-1, 0, 1, 2), joints, joints + 0.1 * out, np.array([0.0, 1.0]), turns, shifts, 4.0)


def test_a_scene_gives_the_turns_of_its_bones(session):
    motion = motion_of_session(session, 2.0)
    assert motion.seconds[-1] == 2.0 and len(motion.seconds) == 25
    start = bone_transforms(0.0)
    for index in (6, 18):
        now = bone_transforms(motion.seconds[index] / 2.0)
        for name in ("torso", "head", *ARM):
            row = motion.row(name)
            wanted = now[name][:3, :3] @ start[name][:3, :3].T
            np.testing.assert_allclose(to_matrix(motion.turns[index, row]), wanted, atol=2e-2)
            np.testing.assert_allclose(motion.shifts[index, row], now[name][:3, 3] - start[name][:3, 3], atol=2e-2)
    assert motion.parents[motion.row("elbow_left")] == motion.row("shoulder_left")
    with pytest.raises(UserError, match="no part 'tail'"):
        motion.row("tail")


def test_a_scene_gives_what_its_film_shows(session):
    """Keyframes on a frozen scene, at the moments of a film of another length; joints are those of its beginning."""
    edit = session.edit
    session.turn("shoulder_left", 30, (0, -1, 0))
    session.add_keyframe(0.0, "linear")
    session.turn("shoulder_left", 60, (0, -1, 0))
    session.add_keyframe(4.0)
    session.apply(dataclasses.replace(session.edit, targets={}, playback=Playback(freeze=0.25)))
    motion, row = motion_of_session(session, 2.0), session.skeleton.names.index("elbow_left")
    assert motion.moves
    begin = session.joint_of("elbow_left", 0.25, 0.0)
    np.testing.assert_allclose(motion.joints[row], begin, atol=1e-9)
    half = motion.seconds.tolist().index(1.0)
    moved = session.joint_of("elbow_left", 0.25, 2.0) - begin
    assert np.linalg.norm(moved) > 0.1
    np.testing.assert_allclose(motion.shifts[half, row], moved, atol=0.03)
    np.testing.assert_allclose(motion.turns[half, row], from_axis((0, -1, 0), 30), atol=0.05)
    session.apply(dataclasses.replace(edit, playback=Playback(seconds=2.0, repeat="loop")))
    looped = motion_of_session(session, 2.0)
    np.testing.assert_allclose(looped.turns[0], looped.turns[12], atol=1e-6)
    assert np.abs(looped.turns[-1] - looped.turns[0]).max() > 0.01
    session.apply(dataclasses.replace(edit, playback=Playback(freeze=0.5)))
    assert not motion_of_session(session, 2.0).moves


def test_a_scene_plays_its_own_motion_on_itself(session):
    """Frozen at its first instant, the figure shows at every keyframe the pose that it had."""
    motion = motion_of_session(session, 2.0)
    wanted = session.node_positions(0.5)
    assert set(retarget(session, motion)) == set(session.skeleton.names)
    found = session.node_positions(session.scene_time(1.0), 1.0)
    assert np.median(np.linalg.norm(found - wanted, axis=1)) < 0.02
    assert np.linalg.norm(session.node_positions(0.0) - wanted, axis=1).mean() > 0.05
    assert session.edit.film.seconds == 2.0 and session.undo() and not session.edit.handles


def test_pins_of_an_earlier_edit_do_not_hold_the_body(session):
    session.pin(range(0, len(session), 3))
    retarget(session, motion_of_session(session, 2.0))
    assert not session.edit.pins and session.undo() and session.edit.pins


@pytest.mark.parametrize("flip", [False, True])
def test_limbs_point_where_those_of_the_source_point(session, flip):
    motion = arm_motion(-40.0, 50.0, flip)
    matched = retarget(session, motion, travel=False)
    assert matched == {"torso": "torso", "shoulder_left": "Shoulder_Left", "elbow_left": "elbow_left"}
    for second, index in ((0.0, 0), (1.0, 1)):
        joints = [_joint(session, name, second) for name in ARM]
        there = rotate(motion.turns[index, 1], motion.joints[2] - motion.joints[1])
        here = joints[1] - joints[0]
        np.testing.assert_allclose(here / np.linalg.norm(here), there / np.linalg.norm(there), atol=1e-6)


def _joint(session: EditSession, part: str, at: float) -> np.ndarray:
    return session.joint_of(part, session.scene_time(at), at)


def test_a_matched_root_travels_by_the_ratio_of_the_heights(session):
    root = next(part.name for part in session.skeleton.parts if part.parent is None)
    retarget(session, arm_motion(0.0, 0.0), {root: "torso"})
    before, after = session.node_positions(0.0, 0.0), session.node_positions(0.0, 1.0)
    height = np.ptp(before[:, 2])
    np.testing.assert_allclose(
        after - before, np.tile(height / 4.0 * np.array([0.2, -1.0, 0.0]), (len(after), 1)), atol=1e-6
    )


def upside(session: EditSession, up: tuple[float, float, float]) -> EditSession:
    """The same scene, of which another direction is up."""
    scene = copy.copy(session.scene)
    scene.overview = dataclasses.replace(scene.overview, up=up)
    other = EditSession(scene)
    other.edit = session.edit
    return other


@pytest.mark.parametrize("up", [(0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (0.6, 0.0, 0.8)])
def test_what_is_up_in_the_motion_is_up_in_the_scene(session, up):
    other = upside(session, up)
    root = next(part.name for part in session.skeleton.parts if part.parent is None)
    motion = arm_motion(30.0, 0.0)
    motion.shifts[1] = [0.0, 0.0, 0.5]
    before = other.node_positions(0.0, 0.0)
    retarget(other, motion, {root: "torso"})
    after = other.node_positions(0.0, 1.0)
    height = np.ptp(before @ np.array(up))
    np.testing.assert_allclose(after - before, np.tile(height / 8.0 * np.array(up), (len(after), 1)), atol=1e-6)


def test_a_motion_is_the_same_whatever_is_up(session):
    """What one scene gives and the same scene takes does not depend on the name of its axes."""
    other = upside(session, (0.0, -1.0, 0.0))
    motion = motion_of_session(other, 2.0)
    wanted = session.node_positions(0.5)
    retarget(other, motion)
    found = other.node_positions(other.scene_time(1.0), 1.0)
    assert np.median(np.linalg.norm(found - wanted, axis=1)) < 0.02
    plain = motion_of_session(session, 2.0)
    back = motion.turned(least_turn(np.array(UP), np.array([0.0, -1.0, 0.0])))
    np.testing.assert_allclose(back.joints, plain.joints, atol=1e-9)
    np.testing.assert_allclose(back.shifts, plain.shifts, atol=1e-9)
    np.testing.assert_allclose(to_matrix(back.turns), to_matrix(plain.turns), atol=1e-9)


def test_least_turns():
    random = np.random.default_rng(0)
    for _ in range(20):
        first, second = random.normal(size=(2, 3))
        turned = rotate(least_turn(first, second), first)
        np.testing.assert_allclose(np.cross(turned, second), 0.0, atol=1e-9)
        assert turned @ second > 0
        np.testing.assert_allclose(rotate(least_turn(first, -first), first), -first, atol=1e-9)
    np.testing.assert_array_equal(least_turn(np.zeros(3), first), IDENTITY)


def test_mistakes_get_one_line_and_change_nothing(session):
    before = session.edit
    motion = arm_motion(10.0, 10.0)
    with pytest.raises(UserError, match="no part of the motion is matched"):
        retarget(session, motion, {})
    with pytest.raises(UserError, match="no part 'paw'"):
        retarget(session, motion, {"torso": "paw"})
    with pytest.raises(UserError, match="no part is called 'paw'"):
        retarget(session, motion, {"paw": "torso"})
    with pytest.raises(UserError, match="give 0 to 1"):
        retarget(session, motion, time=2.0)
    with pytest.raises(UserError, match="more than 0"):
        motion_of_session(session, 0.0)
    assert session.edit is before


def test_names_that_nobody_gave_match_nothing(session):
    motion = arm_motion(0.0, 0.0)
    numbered = dataclasses.replace(motion, names=("part-1", "part-2", "elbow_left", "part-4"))
    skeleton = dataclasses.replace(
        session.skeleton, parts=tuple(dataclasses.replace(part, parent=None) for part in session.skeleton.parts)
    )
    skeleton = dataclasses.replace(
        skeleton, parts=(dataclasses.replace(skeleton.parts[0], name="part-2"), *skeleton.parts[1:])
    )
    assert match_names(skeleton, numbered) == {"elbow_left": "elbow_left"}


def test_names_match_but_for_case(session):
    assert match_names(session.skeleton, arm_motion(0.0, 0.0))["shoulder_left"] == "Shoulder_Left"


def test_a_match_is_read_and_checked(tmp_path):
    path = tmp_path / "match.json"
    path.write_text('{"part-1": "torso"}')
    assert read_match(path) == {"part-1": "torso"}
    path.write_text('{"part-1": 3}')
    with pytest.raises(UserError, match=r"match.json: part-1 is 3; write"):
        read_match(path)
    with pytest.raises(UserError, match="no such file"):
        read_match(tmp_path / "none.json")


def test_a_gltf_character_gives_its_joints():
    folder = os.environ.get("SCGS_DATA")
    path = Path(folder or "") / "animated" / "CesiumMan.glb"
    if folder is None or not path.is_file():
        pytest.skip("SCGS_DATA names no folder with animated/CesiumMan.glb")
    motion = motion_of_gltf(path)
    assert len(motion.names) == len(set(motion.names)) == 19 and motion.seconds[-1] == pytest.approx(2.0, abs=0.05)
    assert (motion.turns[0] == IDENTITY).all() or np.abs(motion.turns[0, :, 0]).min() > 1 - 1e-9
    swings = [np.degrees(2 * np.arccos(np.abs(motion.turns[:, row, 0]).clip(0, 1))).max() for row in range(19)]
    assert max(swings) > 40
    relative = multiply(motion.turns[5, 1], motion.turns[5, 0] * [1, -1, -1, -1])
    assert abs(np.linalg.norm(relative) - 1) < 1e-9


def test_a_file_gives_the_turns_of_its_clip(tmp_path):
    glb, _ = bar()
    motion = motion_of_gltf(glb.save(tmp_path / "bar.glb"))
    assert len(motion.names) == len(set(motion.names)) and motion.parents == (-1, 0)
    assert motion.seconds[-1] == 1.0 and motion.height > 0
    last = to_matrix(motion.turns[-1, 1])
    np.testing.assert_allclose(last @ [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], atol=1e-6)  # glTF's y is z here
    np.testing.assert_allclose(to_matrix(motion.turns[-1, 0]), np.eye(3), atol=1e-9)


def test_a_file_without_animation_is_refused(tmp_path):
    glb = box()
    del glb.document["animations"]
    with pytest.raises(UserError, match="holds no animation"):
        motion_of_gltf(glb.save(tmp_path / "box.glb"))
    with pytest.raises(UserError, match="Jump"):
        motion_of_gltf(box().save(tmp_path / "slide.glb"), "Jump")
