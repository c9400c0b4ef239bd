"""Handles that move as free rigid bodies: the solver's rotation against a minimiser, and what it must do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from helpers.edit_scenes import bar_scene, figure_scene
from helpers.edit_sessions import cloud, graph_of
from scgs_warp.edit import ArapSolver, EditSession
from scgs_warp.edit.graph import ControlGraph
from scgs_warp.edit.handles import Goal, anchors_at
from scgs_warp.edit.rigid_groups import NO_LENGTHS, GroupState, Lengths, nearest_rotation
from scgs_warp.edit.rotations import angle, exponential, from_axis, from_matrix, rotate, to_matrix
from scgs_warp.edit.solver import LONGEST, SHORTEST, Shape, count_steps

Z = np.array([0.0, 0.0, 1.0])
LIMITED = Lengths(2.0, 15.0, SHORTEST, LONGEST)


def free(nodes, rest: np.ndarray, to: np.ndarray, **more) -> Goal:
    """A group whose mean goes to a place."""
    nodes = np.array(nodes)
    return Goal(nodes, np.zeros(3), from_axis(Z, 0), to - rest[nodes].mean(0), gives_rotation=False, free=True, **more)


def global_energy(
    graph: ControlGraph,
    rest: np.ndarray,
    shape: Shape,
    goal: Goal,
    pins: np.ndarray,
    turn: np.ndarray,
    lengths: Lengths,
    before: GroupState,
) -> tuple[float, np.ndarray]:
    """Return the least energy over all free positions, and these, if the group is turned by a matrix. Dense; rotations
    of other nodes are those of ``shape``, and the lengths that edges should keep those of ``before``."""
    anchors = anchors_at([goal], pins, rest, 1.0)
    members, pulls = anchors.groups.members, anchors.soft * np.diff(graph.begin)
    places, rigid = anchors.positions.copy(), members & anchors.hard
    places[members] = anchors.groups.centers[0] + anchors.groups.arms[members] @ turn.T
    rotations = shape.rotations.copy()
    rotations[members] = turn
    i, j = graph.edges.T
    edges = rest[i] - rest[j]
    wanted = 0.5 * np.einsum("eij,ej->ei", rotations[i] + rotations[j], edges)
    turned = 0.5 * np.einsum("eij,ej->ei", before.rotations[i] + before.rotations[j], edges)
    for edge in np.flatnonzero(~(rigid[i] & rigid[j])):
        posed, old = before.positions[i[edge]] - before.positions[j[edge]], np.linalg.norm(edges[edge])
        size = np.linalg.norm(posed)
        along = max(0.0, posed @ turned[edge] / (size * np.linalg.norm(turned[edge])))
        allowed = min(max(size, lengths.shortest * old), lengths.longest * old)
        kept, near = (along * length / size * posed + (1.0 - along) * turned[edge] for length in (old, allowed))
        wanted[edge] += lengths.stretch * kept + lengths.limit * (near - 0.5 * posed)
        wanted[edge] /= 1.0 + lengths.stretch + 0.5 * lengths.limit
    rows = np.zeros((len(i) + len(rest), len(rest)))
    rows[np.arange(len(i)), i], rows[np.arange(len(i)), j] = 1.0, -1.0
    rows[len(i) + np.arange(len(rest)), np.arange(len(rest))] = np.sqrt(pulls)
    right = np.concatenate([wanted, np.sqrt(pulls)[:, None] * places])
    right -= rows[:, anchors.hard] @ places[anchors.hard]
    inner = rows[:, ~anchors.hard]
    found = np.linalg.lstsq(inner, right, rcond=None)[0]
    places[~anchors.hard] = found
    return float(((inner @ found - right) ** 2).sum()), places


@pytest.mark.parametrize("seed", [0, 2, 5])
@pytest.mark.parametrize("stiffness", [None, 0.7])
@pytest.mark.parametrize("lengths", [NO_LENGTHS, LIMITED], ids=["free", "limited"])
def test_one_step_finds_the_best_rotation_and_positions(seed, stiffness, lengths):
    random = np.random.default_rng(seed)
    rest = cloud(seed, 40, (3.0, 1.0, 1.0))
    graph = graph_of(rest, 6)
    order = rest[:, 0].argsort()
    pins, group = order[:8], order[-7:]
    goal = free(group, rest, rest[group].mean(0) + random.normal(size=3), stiffness=stiffness)
    anchors = anchors_at([goal], pins, rest, 1.0)
    assert (graph.component[order[[0, -1]]] == graph.component[order[20]]).all()
    shape = Shape(
        rest + 0.1 * random.normal(size=rest.shape), to_matrix(exponential(random.normal(size=(40, 3)) * 0.3))
    )
    start = to_matrix(exponential(random.normal(size=3) * 0.2))
    shape.rotations[group], shape.rotations[pins] = start, np.eye(3)
    solver = ArapSolver(graph, 0.0, lengths.stretch, lengths.limit)
    system = solver._system(anchors)
    groups = solver._groups(system, anchors, rest)
    state = GroupState(shape.positions.copy(), shape.rotations.copy(), anchors.positions.copy(), shape.rotations.copy())
    groups.start(state)
    before = state.positions.copy()
    old = GroupState(before, state.rotations.copy(), state.targets, state.asked)
    state.positions[:] = global_energy(graph, rest, shape, goal, pins, groups.rotations[0], lengths, old)[1]
    groups.turn(state, before, lengths)

    def energy(vector: np.ndarray) -> float:
        return global_energy(graph, rest, shape, goal, pins, to_matrix(exponential(vector)), lengths, old)[0]

    best = min((minimize(energy, x, method="BFGS", options={"gtol": 1e-9}) for x in 0.5 * random.normal(size=(4, 3))),
               key=lambda result: result.fun)  # fmt: skip
    found, positions = groups.rotations[0], state.positions
    lowest, expected = global_energy(graph, rest, shape, goal, pins, found, lengths, old)
    assert lowest <= best.fun * (1 + 1e-6) + 1e-12
    np.testing.assert_allclose(found, to_matrix(exponential(best.x)), atol=1e-4)
    np.testing.assert_allclose(positions, expected, atol=1e-8)
    assert energy(np.zeros(3)) > 1.01 * lowest, "the rotation matters"


@pytest.mark.parametrize("degrees", [30, 90, 150])
def test_a_free_group_joins_a_rigid_motion(degrees):
    """One end is turned by a handle; the other end's centre goes to where the same turn takes it."""
    rest = cloud(4, 120, (4.0, 0.4, 0.4))
    graph = graph_of(rest)
    left, right = np.flatnonzero(rest[:, 0] < -3), np.flatnonzero(rest[:, 0] > 3)
    quat = from_axis((0.3, 1.0, 0.2), degrees)
    goals = [Goal(left, np.zeros(3), quat, np.zeros(3))]

    def path(share: float):
        turned = from_axis((0.3, 1.0, 0.2), share * degrees)
        return anchors_at(
            [*goals, free(right, rest, rest[right].mean(0))], np.zeros(0, np.int64), rest, share
        )._replace(
            groups=anchors_at(
                [free(right, rest, rotate(turned, rest[right].mean(0)))], np.zeros(0, np.int64), rest, 1.0
            ).groups
        )

    found = ArapSolver(graph).solve(rest, path, count_steps(np.radians(degrees), 0.0, graph.edge_length))
    np.testing.assert_allclose(found.positions, rotate(quat, rest), atol=5e-3)
    np.testing.assert_allclose(found.rotations[right], np.tile(to_matrix(quat), (len(right), 1, 1)), atol=5e-3)


def test_two_free_groups_pull_a_bar_straight():
    rest = cloud(5, 150, (4.0, 0.4, 0.4))
    graph = graph_of(rest)
    ends = np.flatnonzero(rest[:, 0] < -3), np.flatnonzero(rest[:, 0] > 3)
    turn = from_axis(Z, 60)
    goals = [free(end, rest, rotate(turn, rest[end].mean(0))) for end in ends]
    steps = count_steps(0.0, max(goal.sweep()[1] for goal in goals), graph.edge_length)
    found = ArapSolver(graph).solve(rest, lambda share: anchors_at(goals, np.zeros(0, np.int64), rest, share), steps)
    for end in ends:
        off = from_matrix(found.rotations[end] @ to_matrix(turn).T)
        assert np.degrees(angle(off)).max() < 10, "both turn with the bar, up to a spin about its axis"


def test_a_stiff_free_group_ends_where_a_fixed_one_does():
    session = EditSession(bar_scene())
    ends = session.node_positions(0.0)[:, 0].argsort()
    poses = []
    for stiffness in (None, 1e4):
        session.reset()
        session.pin(ends[:10].tolist())
        session.add_handle(ends[-8:].tolist(), 0.0, "end", stiffness=stiffness)
        session.move("end", (-0.1, 0.1, 0.3))
        poses.append(session.node_positions(0.0))
    np.testing.assert_allclose(poses[0], poses[1], atol=2e-3)


def test_live_drags_settle_where_the_solution_is():
    session = EditSession(bar_scene())
    ends = session.node_positions(0.0)[:, 0].argsort()
    session.pin(ends[:10].tolist())
    session.add_handle(ends[-8:].tolist(), 0.0, "end")
    for share in np.linspace(0.05, 1.0, 20):
        session.drag("end", (-0.15 * share, 0.0, 0.3 * share))
        live = session.node_positions(0.0, live=True)
    for _ in range(80):
        live = session.node_positions(0.0, live=True)
    session.release()
    np.testing.assert_allclose(live, session.node_positions(0.0), atol=1e-2)


def test_pulling_a_hand_bends_less_than_holding_its_rotation():
    """The hand of the built-in figure goes to where a turn of the shoulder by 60 degrees takes it."""
    session = EditSession(figure_scene()[0])
    rest = session.node_positions(0.0)
    joint, hand = np.array([0.365, 0.0, 0.09]), (0.40, -0.15, -0.55)
    chosen = session.ring([session.nearest(hand, 0.0)], 2)
    center = rest[list(chosen)].mean(0)
    shift = rotate(from_axis((0, -1, 0), 60), center - joint) + joint - center
    strains = []
    first, second = session.graph.edges.T
    for turns in (None, True):
        session.reset()
        session.add_handle(chosen, 0.0, "hand", turns=turns)
        session.pin_rest(rings=8)
        session.move("hand", shift.tolist())
        posed = session.node_positions(0.0)
        assert np.linalg.norm(posed[list(chosen)].mean(0) - center - shift) < 1e-9
        lengths = [np.linalg.norm(x[first] - x[second], axis=1) for x in (rest, posed)]
        strains.append(float(np.abs(lengths[1] / lengths[0] - 1.0).max()))
    assert strains[0] < 0.75 * strains[1], strains


def test_one_turn_in_any_keyframe_fixes_the_rotation_everywhere():
    session = EditSession(bar_scene())
    ends = session.node_positions(0.0)[:, 0].argsort()
    session.pin(ends[:10].tolist())
    nodes = ends[-8:].tolist()
    session.add_handle(nodes, 0.0, "end")
    session.move("end", (0.0, 0.0, 0.2))
    assert np.degrees(angle(session.rotation_of("end", 0.0))) > 3
    session.add_keyframe(0.0)
    session.move("end", (0.0, 0.0, 0.2), from_axis(Z, 25).tolist())
    session.add_keyframe(1.0)
    assert np.degrees(angle(session.rotation_of("end", 0.0, at=0.0))) == pytest.approx(0.0, abs=1e-6)
    assert np.degrees(angle(session.rotation_of("end", 0.0, at=1.0))) == pytest.approx(25.0, abs=1e-6)


def test_degenerate_groups():
    rest = np.zeros((6, 3))
    rest[:, 0] = [0, 1, 2, 3, 3, 4]
    graph = graph_of(rest, 2)
    shift = np.array([0.0, 0.3, 0.0])
    for nodes in ([3, 4], [4, 5], list(range(6)), [2, 3, 5]):
        goal = free(nodes, rest, rest[nodes].mean(0) + shift)
        found = ArapSolver(graph).solve(rest, lambda share: anchors_at([goal], np.array([0]), rest, share), 3)  # noqa: B023
        assert np.isfinite(found.positions).all() and np.linalg.det(found.rotations).min() > 0.999
        np.testing.assert_allclose(found.positions[nodes].mean(0), rest[nodes].mean(0) + shift, atol=1e-9)


def test_the_nearest_rotation_of_a_matrix_without_rank():
    turn = to_matrix(from_axis((1, 2, 3), 40))
    np.testing.assert_array_equal(nearest_rotation(np.zeros((3, 3)), turn), turn)
    np.testing.assert_allclose(nearest_rotation(2.0 * turn, np.eye(3)), turn, atol=1e-7)
    line = np.outer(turn @ [1.0, 0, 0], [1.0, 0, 0])
    found = nearest_rotation(line, turn)
    np.testing.assert_allclose(found, turn, atol=1e-6)
    assert np.linalg.det(nearest_rotation(-np.eye(3), np.eye(3))) > 0.999
