"""Changes of a skeleton while parts are posed: merging, splitting, another number of parts; chains and owners."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from helpers.edit_scenes import furthest
from scgs_warp.edit.rotations import from_axis, rigid_fit, rotate
from scgs_warp.edit.skeleton import Part, Skeleton, strongest
from scgs_warp.errors import UserError

ARM = ("shoulder_left", "elbow_left")


def test_the_skeleton_is_changed_and_undone(session):
    names = session.skeleton.names
    session.turn("elbow_left", 30, (1, 0, 0))
    session.rename_part("elbow_left", "left forearm")
    assert session.edit.handles[0].part == "left forearm"
    assert session.chain("left forearm") == ("left forearm", "shoulder_left")
    nodes = session.skeleton.part("left forearm").nodes
    low = [
        n for n in nodes if session.node_positions(0.0)[n, 2] < np.median(session.node_positions(0.0)[list(nodes), 2])
    ]
    new = session.split_part("left forearm", low, "left hand")
    assert session.skeleton.part(new).parent == "left forearm"
    assert sorted((*session.skeleton.part(new).nodes, *session.skeleton.part("left forearm").nodes)) == list(nodes)
    session.move_joint("left hand", (0.5, -0.1, -0.4), (0, 0, 2))
    assert session.skeleton.part("left hand").axis == (0.0, 0.0, 1.0)
    session.merge_parts("left forearm", "left hand")
    assert session.skeleton.part("left forearm").nodes == nodes and session.skeleton.source == "edited"
    session.merge_parts("shoulder_left", "left forearm")
    assert not session.edit.handles, "the handle of a part that is gone goes with it"
    for _ in range(6):
        assert session.undo()
    assert session.skeleton.names == names


def test_handles_that_are_called_after_a_part_are_renamed_with_it(session):
    def names() -> set[str]:
        return {handle.name for handle in session.edit.handles}

    session.turn("elbow_left", 30, (1, 0, 0), 0.25)
    frame = dataclasses.replace(session.edit.handles[0], lasts="frame")
    session.apply(dataclasses.replace(session.edit, handles=(frame,)))
    session.add_keyframe(1.0)
    session.turn("elbow_left", 20, (1, 0, 0), 0.75)
    session.add_handle(session.skeleton.part("head").nodes[:1], 0.0, "forearm (2)")
    before = session.node_positions(0.25)
    assert names() == {"elbow_left", "elbow_left (2)", "forearm (2)"}
    session.rename_part("elbow_left", "forearm")
    assert names() == {"forearm", "forearm (3)", "forearm (2)"}
    assert set(session.edit.targets) == {"forearm", "forearm (3)"}
    assert set(session.edit.keyframes[0].targets) == {"forearm"}
    np.testing.assert_array_equal(session.node_positions(0.25), before)
    session.rename_handle("forearm", "my handle")
    session.rename_part("forearm", "lower arm")
    assert names() == {"my handle", "lower arm", "forearm (2)"}, "names that somebody gave stay"


def test_a_handle_of_merged_parts_is_called_after_the_whole(session):
    session.turn("shoulder_left", 20, (0, -1, 0))
    session.merge_parts(*ARM[::-1])
    assert [(handle.name, handle.part) for handle in session.edit.handles] == [("elbow_left", "elbow_left")]
    assert set(session.edit.targets) == {"elbow_left"}


@pytest.mark.parametrize("order", [ARM, ARM[::-1]])
def test_a_merged_part_turns_as_the_upper_one_did(session, order):
    """Under either name: what hangs above the joint between the two stays where it is."""
    upper = list(session.skeleton.part("shoulder_left").nodes)
    session.turn("elbow_left", 60, (1, 0, 0))
    bent, rest = session.edit, session.engine.to_world(session.engine.motion_at(0.0).positions)
    session.merge_parts(*order)
    assert session.skeleton.part(order[0]).parent == "torso" and not session.edit.handles
    np.testing.assert_array_equal(session.node_positions(0.0), rest)
    assert session.undo() and session.edit == bent
    session.turn("shoulder_left", 70, (0, -1, 0))
    before = session.node_positions(0.0)
    session.merge_parts(*order)
    assert [handle.part for handle in session.edit.handles] == [order[0]]
    whole = furthest(session, order[0])
    moved = rigid_fit(rest[whole], session.node_positions(0.0)[whole])[0]
    np.testing.assert_allclose(moved, from_axis((0, -1, 0), 70), atol=1e-9)
    off = np.linalg.norm(session.node_positions(0.0) - before, axis=1)
    trunk = sorted(set(range(len(session))) - set(session.skeleton.part(order[0]).nodes))
    assert off[upper].mean() < 0.04 and off[trunk].max() < 0.02, (off[upper].mean(), off[trunk].max())


def test_a_part_hangs_on_another_one_and_a_root_too(session):
    """What hangs on a part comes with it, and the turn of the new parent carries both."""
    session.attach_part("shoulder_left", None)
    loose = session.skeleton.part("shoulder_left")
    places = session.node_positions(0.0)
    assert loose.parent is None and loose.degrees == 0.0
    np.testing.assert_allclose(loose.joint, places[list(loose.nodes)].mean(0))
    session.attach_part("shoulder_left", "head")
    arm = session.skeleton.part("shoulder_left")
    assert arm.parent == "head" and session.skeleton.part("elbow_left").parent == "shoulder_left"
    near = [
        np.linalg.norm(places[list(session.skeleton.part(n).nodes)] - arm.joint, axis=1) for n in (arm.name, "head")
    ]
    assert near[0].min() < np.median(near[0]) and abs(near[0].min() - near[1].min()) < 0.1
    moved, joint, turn = furthest(session, "elbow_left"), session.joint_of("head", 0.0), from_axis((0, 0, 1), 40)
    session.turn("head", 40, (0, 0, 1))
    wanted = rotate(turn, places[moved] - joint) + joint
    np.testing.assert_allclose(session.node_positions(0.0)[moved], wanted, atol=1e-6)
    for _ in range(3):
        assert session.undo()
    assert session.skeleton.part("shoulder_left").parent == "torso"


def test_a_root_is_attached_and_no_part_hangs_on_itself():
    point = (0.0, 0.0, 0.0)
    skeleton = Skeleton(
        (Part("table", (0, 1), None, point), Part("ball", (2,), None, point), Part("pin", (3,), "ball", point))
    )
    places, edges = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [4, 0, 0]]), np.zeros((0, 2), int)
    joined = skeleton.attached("ball", "table", places, edges)
    assert joined.part("ball").parent == "table" and joined.part("ball").joint == (2.0, 0.0, 0.0)
    assert joined.branch("table") == ("table", "ball", "pin") and joined.source == "edited"
    assert joined.attached("ball", "table", places, edges) is joined
    for parent, message in (
        ("ball", "on itself"),
        ("pin", "attach 'pin' elsewhere first"),
        ("chair", "no part is called"),
    ):
        with pytest.raises(UserError, match=message):
            skeleton.attached("ball", parent, places, edges)


def test_a_side_branch_of_equal_size_ends_a_chain():
    """A finger moves without its hand, but a fragment on the upper arm does not stop the hand."""

    def part(name, size, parent):
        start = part.next
        part.next += size
        return Part(name, tuple(range(start, start + size)), parent, (0.0, 0.0, 0.0))

    part.next = 0
    tree = [("trunk", 50, None), ("arm", 9, "trunk"), ("fleck", 2, "arm"), ("forearm", 9, "arm")]
    tree += [("hand", 6, "forearm"), ("index", 3, "hand"), ("thumb", 3, "hand"), ("leg", 20, "trunk")]
    skeleton = Skeleton(tuple(part(*row) for row in tree))
    assert skeleton.chain("thumb") == ("thumb",)
    assert skeleton.chain("hand") == ("hand", "forearm", "arm")
    assert skeleton.chain("leg") == ("leg",) and skeleton.chain("trunk") == ("trunk",)
    assert skeleton.branch("arm") == ("arm", "fleck", "forearm", "hand", "index", "thumb")


def test_a_number_of_parts_replaces_the_skeleton(figure):
    session = figure.fork()
    session.turn("head", 20, (0, 0, 1))
    session.add_keyframe(0.0)
    session.add_handle([3, 4], 0.0, "free")
    session.add_keyframe(1.0)
    session.use_parts(6)
    assert len(session.skeleton.parts) == 6 and [h.name for h in session.edit.handles] == ["free"]
    assert [(frame.at, list(frame.targets)) for frame in session.edit.keyframes] == [(1.0, ["free"])]
    assert not session.edit.targets
    assert session.undo() and session.edit.handle("head") is not None


def test_a_gaussian_belongs_to_the_part_with_most_of_its_weight(session):
    random = np.random.default_rng(0)
    labels, weights = random.integers(0, 3, (50, 4)), random.random((50, 4))
    wanted = [max(range(3), key=lambda part: weights[row, labels[row] == part].sum()) for row in range(50)]
    assert strongest(labels, weights).tolist() == wanted
    owner, found = session.skeleton.owners(), session.gaussian_parts()
    assert found.shape == (session.scene.gaussian_count,)
    assert (owner[session.engine.binding[0].numpy()] == found[:, None]).any(1).all()
    points = session.gaussians_at(0.3).means.double().numpy()
    for index in random.integers(0, len(points), 5).tolist():
        assert session.part_at(points[index].tolist(), 0.3) == session.skeleton.names[found[index]]
