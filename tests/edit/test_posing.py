"""Posing parts: forward kinematics against matrices, pulls against a general minimiser, skeletons, files, undo."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, shortest_path

from helpers.edit_scenes import furthest
from scgs_warp.data.synthetic.figure_motion import bone_transforms
from scgs_warp.edit import EditSession
from scgs_warp.edit.handles import STAY
from scgs_warp.edit.part_pose import FREE_RINGS, INNER_STIFFNESS, PartMove, PartPoser, _rings_to_others
from scgs_warp.edit.rotations import from_axis, logarithm, rigid_fit, rotate, to_matrix
from scgs_warp.edit.skeleton import Part, Skeleton
from scgs_warp.errors import UserError

ARM = ("shoulder_left", "elbow_left")


def matrix(quat: np.ndarray, point: np.ndarray, shift: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the homogeneous matrix of a turn about a point, then a shift."""
    found = np.eye(4)
    found[:3, :3] = to_matrix(quat)
    found[:3, 3] = point + shift - found[:3, :3] @ point
    return found


def still_nodes(session: EditSession) -> list[int]:
    """Return the control points that are more than ``FREE_RINGS`` edges from the left arm, and not of it."""
    names = session.skeleton.names
    arm = np.isin(session.skeleton.owners(), [names.index(name) for name in ARM])
    away = shortest_path(session.engine.poser(session.skeleton).graph.matrix, unweighted=True)[:, arm].min(1)
    return np.flatnonzero(away > FREE_RINGS).tolist()


def test_a_turned_part_carries_those_that_hang_on_it(session):
    start = session.node_positions(0.0)
    upper, lower = from_axis((0, -1, 0), 70), from_axis((1, 0, 0), 40)
    session.turn("shoulder_left", 70, (0, -1, 0))
    session.turn("elbow_left", 40, (1, 0, 0))
    joints = bone_transforms(0.0)
    first = matrix(upper, joints["shoulder_left"][:3, 3])
    both = first @ matrix(lower, joints["elbow_left"][:3, 3])
    poser = session.engine.poser(session.skeleton)
    motions, body = poser.motions(_moves(session), session.engine.motion_at(0.0).positions)
    for name, wanted in (("shoulder_left", first), ("elbow_left", both), ("torso", np.eye(4))):
        motion = motions[poser.rows[name]]
        np.testing.assert_allclose(to_matrix(motion.quat), wanted[:3, :3], atol=1e-12)
        np.testing.assert_allclose(motion.shift, wanted[:3, 3], atol=1e-12)
    posed = session.node_positions(0.0)
    tip = furthest(session, "elbow_left")
    truth = start[tip] @ both[:3, :3].T + both[:3, 3]
    np.testing.assert_allclose(posed[tip], truth, atol=1e-9)
    still = still_nodes(session)
    assert len(still) > 100
    assert np.array_equal(posed[still], start[still])
    assert body[poser.rows["torso"]] == -1 and body[poser.rows["elbow_left"]] == poser.rows["elbow_left"]


@pytest.mark.parametrize(
    ("part", "axis", "most"),
    [("shoulder_left", (0, -1, 0), 0.2), ("hip_left", (-1, 0, 0), 0.3), ("knee_left", (1, 0, 0), 0.4)],
)
def test_a_turned_joint_shares_its_bend_among_edges(session, part, axis, most):
    """Without the limit on lengths, the worst edge changes by 0.27, 0.38 and 0.5."""
    start = session.node_positions(0.0)
    session.turn(part, 90, axis)
    ends = session.engine.poser(session.skeleton).graph.edges.T
    before, after = (np.linalg.norm(x[ends[0]] - x[ends[1]], axis=1) for x in (start, session.node_positions(0.0)))
    assert 0.1 < np.abs(after / before - 1.0).max() < most


def _moves(session: EditSession):
    then = session.engine.motion_at(0.0).positions
    return [PartMove(h, session.edit.targets.get(h.name, STAY), 1.0, then) for h in session.edit.handles]


def test_a_turn_follows_its_parent_through_the_motion(session):
    """At another time the elbow's turn is given in the upper arm's frame, and its joint has moved with the arm."""
    session.turn("elbow_left", 50, (0, 0, 1))
    then, now = bone_transforms(0.0), bone_transforms(0.4)
    frame = now["shoulder_left"][:3, :3] @ then["shoulder_left"][:3, :3].T
    turn = np.eye(4)
    turn[:3, :3] = frame @ to_matrix(from_axis((0, 0, 1), 50)) @ frame.T
    joint = now["elbow_left"][:3, 3]
    turn[:3, 3] = joint - turn[:3, :3] @ joint
    start, posed = session.engine.motion_at(0.4).positions, session.node_positions(0.4)
    tip = furthest(session, "elbow_left")
    np.testing.assert_allclose(posed[tip], start[tip] @ turn[:3, :3].T + turn[:3, 3], atol=2e-4)
    assert np.abs(posed[tip] - start[tip]).max() > 0.1


def test_turns_add_up_and_are_undone_one_by_one(session):
    before = session.edit
    session.turn("shoulder_left", 30, (0, 1, 0))
    once = session.edit
    session.turn("shoulder_left", 30, (0, 1, 0))
    angle = np.degrees(np.linalg.norm(logarithm(np.array(session.edit.targets["shoulder_left"].rotation))))
    assert angle == pytest.approx(60)
    assert session.undo() and session.edit == once
    assert session.undo() and session.edit == before
    assert session.redo() and session.edit == once


def test_a_pull_takes_the_grip_and_leaves_the_trunk(session):
    start = session.node_positions(0.0)
    hand = session.skeleton.part("elbow_left").nodes
    grip = start[list(hand)].mean(0)
    shoulder = bone_transforms(0.0)["shoulder_left"][:3, 3]
    place = rotate(from_axis((0, -1, 0), 60), grip - shoulder) + shoulder
    assert session.chain("elbow_left") == ("elbow_left", "shoulder_left")
    assert session.pull("elbow_left", place) == ("elbow_left", "shoulder_left")
    after = session.node_positions(0.0)
    assert np.linalg.norm(after[list(hand)].mean(0) - place) < 0.03
    still = still_nodes(session)
    assert np.array_equal(after[still], start[still])
    turned = session.edit.targets["shoulder_left"].rotation
    assert np.degrees(np.linalg.norm(logarithm(np.array(turned)))) == pytest.approx(60, abs=4), "the limb swings whole"
    assert session.undo()
    assert not session.edit.handles, "a pull is one step"


def test_a_part_that_one_frame_poses_is_posed_at_other_moments_too(session):
    session.turn("head", 40, (0, 0, 1), 0.5)
    (first,) = session.edit.handles
    session.apply(dataclasses.replace(session.edit, handles=(dataclasses.replace(first, lasts="frame"),)))
    frame = session.node_positions(0.5)
    before = session.node_positions(0.2)
    tip = furthest(session, "head")
    session.turn("head", -30, (0, 0, 1), 0.2)
    turned = rigid_fit(before[tip], session.node_positions(0.2)[tip])[0]
    np.testing.assert_allclose(turned, from_axis((0, 0, 1), -30), atol=0.02)
    np.testing.assert_array_equal(session.node_positions(0.5), frame, "the frame keeps its pose")
    assert [handle.time for handle in session.edit.handles] == [0.2, 0.5]
    session.turn("head", -30, (0, 0, 1), 0.2)
    session.turn("head", 10, (0, 0, 1), 0.5)
    assert len(session.edit.handles) == 2, "each is turned further where it shows"
    assert not np.array_equal(session.node_positions(0.5), frame)


def test_a_dragged_pull_is_measured_from_its_beginning(session):
    session.turn("shoulder_left", 20, (0, 1, 0))
    begin = session.edit
    for place in ((0.9, 0.1, 0.1), (0.7, -0.4, 0.3)):
        session.pull("elbow_left", place, live=True)
    session.release()
    dragged = session.edit
    assert session.undo() and session.edit == begin
    session.pull("elbow_left", (0.7, -0.4, 0.3))
    assert session.edit == dragged


def test_a_pulled_root_moves_all(session):
    root = next(part.name for part in session.skeleton.parts if part.parent is None)
    start = session.node_positions(0.0)
    session.pull(root, start[list(session.skeleton.part(root).nodes)].mean(0) + np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(
        session.node_positions(0.0) - start, np.tile([0.1, 0.2, 0.3], (len(start), 1)), atol=1e-6
    )


def test_keyframes_interpolate_the_angle(session):
    session.pose_part("elbow_left")
    session.add_keyframe(0.0, "linear")
    session.turn("elbow_left", 80, (1, 0, 0))
    session.add_keyframe(2.0)
    quat = np.array(session.engine.targets(session.edit, 0.5)["elbow_left"].rotation)
    np.testing.assert_allclose(logarithm(quat), np.radians([20.0, 0, 0]), atol=1e-12)
    assert not np.array_equal(session.node_positions(0.0, at=0.5), session.node_positions(0.0, at=0.0))


def test_live_results_reach_the_exact_ones(session):
    for place in np.linspace((0.56, -0.15, -0.4), (0.9, -0.2, 0.1), 12):
        session.pull("elbow_left", place, live=True)
        live = session.node_positions(0.0, live=True)
    for _ in range(40):
        live = session.node_positions(0.0, live=True)
    session.release()
    np.testing.assert_allclose(live, session.node_positions(0.0), atol=5e-3)


@pytest.mark.parametrize(("part", "axis"), [("shoulder_left", (0, -1, 0)), ("hip_left", (-1, 0, 0))])
def test_the_end_of_a_drag_hardly_moves_anything(session, part, axis):
    """Live updates keep pace with a drag in steps of 5 degrees."""
    for _ in range(24):
        session.rotate(part, from_axis(axis, 5.0), since=session.edit, live=True)
        live = session.node_positions(0.0, live=True)
    session.release()
    edge = session.graph.edge_length / session.engine.units[1]
    assert np.linalg.norm(session.node_positions(0.0) - live, axis=1).max() < 0.04 * edge


def test_a_short_body_between_two_others_is_pulled_not_held(session):
    session.turn("shoulder_left", 70, (0, -1, 0))

    def stiffness() -> dict[str, float | None]:
        poser = session.engine.poser(session.skeleton)
        now = session.engine.motion_at(0.0).positions
        goals = poser.goals(_moves(session), now, np.zeros(len(now), bool))
        return {session.skeleton.names[poser.owner[goal.nodes[0]]]: goal.stiffness for goal in goals}

    assert set(stiffness().values()) == {None}, "the whole arm is one body"
    session.turn("elbow_left", 40, (1, 0, 0))
    found = stiffness()
    assert found.pop("shoulder_left") == INNER_STIFFNESS
    assert "elbow_left" in found and set(found.values()) == {None}


def test_a_part_is_held_as_its_handle_asks(session):
    """The softer it is pulled, the less it is turned; firm, it is where it is without a stiffness."""
    session.pose_part("elbow_left")
    session.turn("elbow_left", 60, (1, 0, 0))
    nodes, (handle,) = furthest(session, "elbow_left"), session.edit.handles
    start, firm = (session.engine.to_world(session.engine.motion_at(0.0).positions), session.node_positions(0.0))
    way = np.linalg.norm(firm - start, axis=1)[nodes].mean()

    def off(**fields) -> float:
        changed = dataclasses.replace(handle, **fields)
        session.edit = dataclasses.replace(session.edit, handles=(changed,))
        return float(np.linalg.norm(session.node_positions(0.0) - firm, axis=1)[nodes].mean() / way)

    found = [off(stiffness=stiffness) for stiffness in (1e-4, 1e-2, 1e4)]
    assert found[0] > 2 * found[1] > 0.02 and found[2] < 1e-3
    assert off(turns=True) == 0.0 and off(stiffness=1e-2, turns=False) > 1.2 * found[1]


@pytest.mark.parametrize("tips", [1, 6, 20])
def test_a_part_between_two_others_keeps_its_turn(session, tips):
    """A small turn of what hangs on a part leaves few of its control points far from both: they must still turn it."""
    part = next(part for part in session.parts() if part.name == "head")
    start = session.node_positions(0.0)
    highest = np.array(part.nodes)[np.argsort(start[list(part.nodes), 2])[::-1][:tips]]
    session.split_part("head", highest.tolist(), "hat")
    own = sorted(set(part.nodes) - set(highest.tolist()))
    session.turn("head", 50, (0, 0, 1))
    alone = session.node_positions(0.0)[own]
    session.turn("hat", 5, (1, 0, 0))
    turns = [rigid_fit(start[own], posed)[0] for posed in (alone, session.node_positions(0.0)[own])]
    degrees = [float(np.degrees(np.linalg.norm(logarithm(turn)))) for turn in turns]
    assert degrees[0] > 40 and degrees[1] > degrees[0] - 3, degrees


def test_rings_are_numbers_of_edges(session):
    graph = session.graph
    label = session.skeleton.owners() % 3
    found = _rings_to_others(graph, label, np.ones(len(graph.neighbors), bool), 4)
    for node in range(0, len(graph), 7):
        away = shortest_path(graph.matrix, unweighted=True, indices=node)[label != label[node]].min()
        within = [other for other in range(len(graph)) if label[other] == label[node]]
        inner = shortest_path(graph.matrix[within][:, within], unweighted=True, indices=within.index(node))
        border = [i for i, other in enumerate(within) if (label[graph.ring([other], 1),] != label[node]).any()]
        least = min((inner[i] + 1 for i in border), default=np.inf)
        assert found[node] == min(least, 4) and found[node] >= min(away, 4)


def test_an_edge_that_bridges_a_gap_frees_nothing(session):
    """A foot that only an edge to the other leg connects to anything: turning its leg leaves the other one alone."""
    start, graph = session.engine.motion_at(0.0).positions, session.graph
    own, other = (np.array(session.skeleton.part(name).nodes) for name in ("knee_left", "knee_right"))
    foot = own[np.argsort(start[own, 2])[:4]]
    bridge = int(foot[0]), int(other[np.linalg.norm(start[other] - start[foot[0]], axis=1).argmin()])
    edges = [edge for edge in graph.edges.tolist() if np.isin(edge, foot).sum() != 1] + [bridge]
    ends = np.array([*edges, *(edge[::-1] for edge in edges)])
    matrix = csr_matrix((np.ones(len(ends)), ends.T), shape=(len(graph), len(graph)))
    rows = {"begin": matrix.indptr, "neighbors": matrix.indices, "weights": matrix.data}
    poser = PartPoser(session.skeleton, dataclasses.replace(graph, **rows), start, session.engine.units)
    assert set(bridge) in map(set, poser.graph.edges.tolist())
    session.turn("hip_left", 40, (1, 0, 0))
    held = {}
    for which in (session.engine.poser(session.skeleton), poser):
        goals = which.goals(_moves(session), start, np.zeros(len(graph), bool))
        held[which] = {node for goal in goals for node in goal.nodes.tolist()} & {*foot.tolist(), *other.tolist()}
    plain, bridged = held.values()
    assert {*foot.tolist(), bridge[1]} <= plain <= bridged


def test_no_edge_of_the_poser_bridges_a_gap_and_none_is_missed(session):
    """The arm hangs beside the trunk: edges between them far from the shoulder go, but nothing falls apart."""
    poser = session.engine.poser(session.skeleton)
    assert len(np.unique(poser.graph.component)) == len(np.unique(session.graph.component))
    assert connected_components(poser.graph.matrix)[0] == connected_components(session.graph.matrix)[0]
    kept = {tuple(edge) for edge in poser.graph.edges.tolist()}
    assert kept <= {tuple(edge) for edge in session.graph.edges.tolist()}
    owner = session.skeleton.owners()
    assert all(tuple(e) in kept for e in session.graph.edges.tolist() if owner[e[0]] == owner[e[1]])


# The skeleton by hand


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda s: s.turn("nose", 10, (1, 0, 0)), "no part is called 'nose'; there is "),
        (lambda s: s.turn("head", 10), "the motion shows no axis"),
        (lambda s: s.turn("head", 10, (0, 0, 0)), "not all close to 0"),
        (lambda s: s.turn("head", 200, (0, 0, 1)), "give -180 to 180"),
        (lambda s: s.turn("head", None, (0, 0, 1)), "degrees is None; give -180 to 180"),
        (lambda s: s.turn("head", 10, "up"), 'axis "up": give 3 finite numbers'),
        (lambda s: s.turn("head", 10, (0, 0, 1), None), "time is None; give a number from 0 to 1"),
        (lambda s: s.pull("head", (0, 0, 1), "now"), "time is 'now'; give a number from 0 to 1"),
        (lambda s: s.joint_of("head", None), "time is None; give a number"),
        (lambda s: s.pull("head", (0, float("nan"), 1)), "give 3 finite numbers"),
        (lambda s: s.pull("head", (0, 0)), "give 3 finite numbers"),
        (lambda s: s.part_at(None, 0.0), "point missing: give 3 finite numbers"),
        (lambda s: s.nearest((float("nan"), 0, 0), 0.0), "point [NaN, 0, 0]: give 3 finite numbers"),
        (lambda s: s.within("up", 1.0, 0.0), "give 3 finite numbers"),
        (lambda s: s.rename_part("head", "torso"), "the name is taken"),
        (lambda s: s.rename_part("head", ""), "give a name"),
        (lambda s: s.merge_parts("head", "knee_left"), "are not neighbours"),
        (lambda s: s.merge_parts("head", "head"), "with itself"),
        (lambda s: s.split_part("head", None), "control points None: give a list of whole numbers"),
        (lambda s: s.split_part("head", [0, 1, 2]), "choose some but not all"),
        (lambda s: s.move_joint("head", (0, 0, float("inf"))), "joint is"),
        (lambda s: s.save_skeleton(), "no run folder"),
    ],
)
def test_mistakes_give_one_line_and_change_nothing(session, call, message):
    before = session.edit
    with pytest.raises(UserError) as raised:
        call(session)
    assert message in str(raised.value) and "\n" not in str(raised.value)
    assert session.edit == before


def test_places_may_be_tensors_that_need_a_gradient(session):
    place = torch.tensor([0.1, 0.2, 0.3], requires_grad=True)
    assert session.nearest(place, 0.0) == session.nearest([0.1, 0.2, 0.3], 0.0)


def test_a_joint_outside_the_motion_is_that_of_its_end(session):
    assert np.array_equal(session.joint_of("elbow_left", 7), session.joint_of("elbow_left", 1.0))


def test_a_part_is_found_where_an_edit_has_put_it(session):
    names = session.skeleton.names
    mine = int(np.flatnonzero(session.gaussian_parts() == names.index("elbow_left"))[0])
    session.turn("shoulder_left", 90, (0, -1, 0))
    point = session.gaussians_at(0.0).means[mine].double().numpy()
    assert session.part_at(point.tolist(), 0.0) == "elbow_left"
    with pytest.raises(UserError, match="3 finite numbers"):
        session.part_at((float("nan"), 0.0, 0.0), 0.0)


@pytest.mark.parametrize("time", [float("nan"), 9, -0.1])
def test_a_time_outside_the_motion_is_refused_also_for_a_part_that_is_posed(session, time):
    session.turn("elbow_left", 20, (1, 0, 0))
    before = session.edit
    with pytest.raises(UserError, match="time is"):
        session.turn("elbow_left", 20, (1, 0, 0), time)
    with pytest.raises(UserError, match="time is"):
        session.rotate("elbow_left", from_axis((1, 0, 0), 20).tolist(), time)
    with pytest.raises(UserError, match="time is"):
        session.pull("elbow_left", (0, 0, 0), time)
    assert session.edit is before


@pytest.mark.parametrize("kind", [list, tuple, np.asarray])
def test_a_joint_takes_numbers_of_numpy(kind):
    joint, axis = np.array([0.5, 1, 2], np.float32), np.array([0, 0, 2], np.float32)
    skeleton = Skeleton((Part("a", (0,), None, (0.0, 0.0, 0.0)),))
    moved = skeleton.with_joint("a", kind(joint), kind(axis)).part("a")
    assert moved.joint == (0.5, 1.0, 2.0) and moved.axis == (0.0, 0.0, 1.0)
    assert all(type(x) is float for x in moved.joint)
