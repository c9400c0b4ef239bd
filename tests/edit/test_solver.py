"""The solver of edits against dense float64 twins, the laws of rigid motion, and degenerate input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.edit_scenes import figure_scene
from helpers.edit_sessions import cloud, graph_of
from helpers.limb_bending import LIMBS, bend, grab
from reference import editing as twin
from scgs_warp.edit import ArapSolver, EditSession
from scgs_warp.edit.graph import ControlGraph
from scgs_warp.edit.handles import Goal, anchors_at
from scgs_warp.edit.rigid_groups import RigidGroups
from scgs_warp.edit.rotations import IDENTITY, angle, from_axis, from_matrix, rotate
from scgs_warp.edit.solver import LONGEST, SHORTEST, Anchors, Shape, count_steps
from scgs_warp.runtime import environment

X, Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def solve(graph: ControlGraph, rest: np.ndarray, goals: list[Goal], pins=(), steps: int = 8, limit=0.0) -> Shape:
    held = np.array(pins, np.int64)
    return ArapSolver(graph, limit=limit).solve(rest, lambda share: anchors_at(goals, held, rest, share), steps)


def turn(nodes, degrees: float = 0.0, axis=(0, 0, 1), shift=(0, 0, 0), pivot=(0, 0, 0), **more) -> Goal:
    return Goal(np.array(nodes), np.array(pivot, float), from_axis(axis, degrees), np.array(shift, float), **more)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize(("stretch", "smooth", "limit"), [(0.0, 0.0, 0.0), (2.0, 0.3, 0.0), (2.0, 0.3, 15.0)])
def test_one_iteration_is_that_of_the_twin(seed, stretch, smooth, limit):
    random = np.random.default_rng(seed)
    rest = cloud(seed, 40)
    graph = graph_of(rest)
    posed = rest + 4.0 * random.normal(size=rest.shape)
    hard = np.arange(40) < 10
    soft = np.where(np.arange(40) % 7 == 6, 0.3, 0.0)
    anchors = Anchors(
        hard, soft, np.zeros(40, bool), posed + 0.0, np.tile(np.eye(3), (40, 1, 1)), np.zeros(40), RigidGroups.none(40)
    )
    found = ArapSolver(graph, smooth, stretch, limit).relax(rest, anchors, Shape(posed, anchors.rotations), 1)
    pulls = soft * np.diff(graph.begin)
    guessed = twin.place_nodes(graph, rest, posed, anchors.rotations, hard, pulls, posed, 0.0)
    rotations = twin.turn_nodes(graph, rest, guessed, anchors.rotations, smooth * graph.edge_length**2)
    np.testing.assert_allclose(found.rotations, rotations, atol=1e-6)
    expected = twin.place_nodes(
        graph, rest, guessed, rotations, hard, pulls, posed, stretch, limit, (SHORTEST, LONGEST)
    )
    np.testing.assert_allclose(found.positions, expected, atol=1e-6)
    assert np.abs(expected - posed).max() > 0.05
    first, second = graph.edges.T
    turned = np.einsum("eij,ej->ei", 0.5 * (rotations[first] + rotations[second]), rest[first] - rest[second])
    reversed_edges = ((guessed[first] - guessed[second]) * turned).sum(1) < 0.0
    assert reversed_edges.any(), "some edges point the wrong way"


@pytest.mark.parametrize("weight", [0.05, 0.7, 20.0])
def test_a_rotation_pulls_as_much_as_it_weighs(weight):
    """One iteration from the guess, against the twin."""
    rest = cloud(14, 40)
    graph, solver = graph_of(rest), ArapSolver(graph_of(rest))
    random = np.random.default_rng(14)
    posed, some = rest + 0.3 * random.normal(size=rest.shape), np.arange(40)
    quats = np.stack([from_axis(random.normal(size=3), random.uniform(-60, 60)) for _ in some])
    asked = np.stack([rotate(quats, np.tile(axis, (40, 1))) for axis in np.eye(3)], axis=2)
    leaning = np.where(some % 5 == 4, weight, 0.0)
    anchors = Anchors(some < 10, np.zeros(40), np.zeros(40, bool), posed, asked, leaning, RigidGroups.none(40))
    guess, found = (solver.relax(rest, anchors, Shape.at_rest(rest), count) for count in (0, 1))
    square = graph.edge_length**2
    pull = leaning * np.diff(graph.begin) * square
    expected = twin.turn_nodes(graph, rest, guess.positions, guess.rotations, solver.smoothness * square, pull, asked)
    np.testing.assert_allclose(found.rotations, expected, atol=1e-6)
    assert np.abs(expected - guess.rotations).max() > 0.05


def test_positions_from_turned_edges_are_those_of_the_twin():
    """Each edge wants the mean of the rotations at its ends."""
    rest = cloud(13, 40)
    graph = graph_of(rest, 8)
    assert len(np.unique(graph.component)) == 1
    degrees = np.random.default_rng(13).uniform(-90, 90, 40)
    quats = np.stack([from_axis((1, 2, 3), each) for each in degrees])
    rotations = np.stack([rotate(quats, np.tile(axis, (40, 1))) for axis in np.eye(3)], axis=2)
    held = np.arange(40) % 9 == 0
    expected = twin.place_nodes(graph, rest, rest, rotations, held, np.zeros(40), rest, 0.0)
    found = ArapSolver(graph).poisson(rest, rotations, held)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.abs(found - rest).max() > 0.1


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000), st.integers(-180, 180), st.integers(-20, 20))
def test_one_handle_without_pins_moves_everything_rigidly(seed, degrees, tenths):
    shift = tenths / 10
    rest = cloud(seed, 50)
    graph = graph_of(rest, 8)
    axis = np.random.default_rng(seed + 1).normal(size=3)
    goal = turn(range(4), degrees, axis, (shift, 0, 0), rest[0])
    found = solve(graph, rest, [goal], steps=count_steps(np.radians(abs(degrees)), abs(shift), graph.edge_length))
    alive = graph.component == graph.component[0]
    expected = rotate(goal.quat, rest - goal.pivot) + goal.pivot + goal.translation
    size = np.ptp(rest, axis=0).max()
    if (graph.component[:4] == graph.component[0]).all():
        np.testing.assert_allclose(found.positions[alive], expected[alive], atol=2e-3 * size)
    np.testing.assert_array_equal(found.positions[~np.isin(graph.component, graph.component[:4])],
                                  rest[~np.isin(graph.component, graph.component[:4])])  # fmt: skip


@pytest.mark.parametrize("stiffness", [{}, {"stiffness": 0.3}], ids=["hard", "soft"])
def test_a_dragged_point_without_pins_shifts_everything(stiffness):
    """A soft one, too: nothing holds the others back."""
    rest = cloud(3, 60)
    graph = graph_of(rest, 8)
    found = solve(graph, rest, [turn([7], shift=(0.5, 0.2, 0), gives_rotation=False, **stiffness)], steps=4)
    alive = graph.component == graph.component[7]
    moved = found.positions[alive] - rest[alive]
    np.testing.assert_allclose(moved, np.broadcast_to([0.5, 0.2, 0], moved.shape), atol=1e-3)


@pytest.mark.parametrize("stiffness", [{}, {"stiffness": 0.3}], ids=["hard", "soft"])
def test_the_first_guess_turns_everything_with_the_only_handle(stiffness):
    """Before any iteration: turns spread harmonically, and one given turn spreads unchanged."""
    rest = cloud(12, 60)
    graph = graph_of(rest, 8)
    alive = graph.component == graph.component[0]
    nodes = np.flatnonzero(alive)[:4]
    anchors = anchors_at([turn(nodes, 70, (1, 2, 3), pivot=rest[0], **stiffness)], np.array([], np.int64), rest, 1.0)
    found = ArapSolver(graph).relax(rest, anchors, Shape.at_rest(rest), 0)
    expected = np.broadcast_to(from_axis((1, 2, 3), 70), (alive.sum(), 4))
    np.testing.assert_allclose(angle(from_matrix(found.rotations[alive])), angle(expected), atol=1e-6)
    np.testing.assert_allclose(np.abs((from_matrix(found.rotations[alive]) * expected).sum(1)), 1.0, atol=1e-9)


@pytest.mark.parametrize(
    ("degrees", "edges", "steps"),
    [(0, 0, 1), (15, 0, 1), (15.1, 0, 2), (180, 0, 12), (0, 2, 1), (0, 2.1, 2), (90, 20, 10), (0, np.inf, 48)],
)
def test_a_handle_goes_in_steps_of_15_degrees_and_two_edges(degrees, edges, steps):
    assert count_steps(np.radians(degrees), edges * 0.2, 0.2) == steps


def test_rotations_are_rotations_and_pins_hold():
    rest = cloud(4, 120, (4.0, 0.4, 0.4))
    graph = graph_of(rest)
    right, left = np.flatnonzero(rest[:, 0] > 4), np.flatnonzero(rest[:, 0] < -4)
    found = solve(graph, rest, [turn(right, 135, (0, 1, 0))], left, steps=9)
    np.testing.assert_allclose(found.rotations @ found.rotations.transpose(0, 2, 1), np.tile(np.eye(3), (120, 1, 1)),
                               atol=1e-6)  # fmt: skip
    assert np.linalg.det(found.rotations).min() > 0.999
    np.testing.assert_array_equal(found.positions[left], rest[left])
    np.testing.assert_array_equal(from_matrix(found.rotations[left]), np.tile(IDENTITY, (len(left), 1)))
    np.testing.assert_allclose(found.positions[right], rotate(from_axis((0, 1, 0), 135), rest[right]), atol=1e-12)
    turned = angle(from_matrix(found.rotations))
    middle = np.abs(rest[:, 0]) < 1
    assert 0.3 < turned[middle].mean() < 2.2, "what lies between shares the turn"


def test_soft_handles_give_way():
    rest = cloud(5, 80)
    graph = graph_of(rest, 8)
    pins = np.flatnonzero(rest[:, 0] < 0)
    reached = []
    for stiffness in (0.01, 1.0, 100.0):
        found = solve(graph, rest, [turn([int(rest[:, 0].argmax())], shift=(1, 0, 0), stiffness=stiffness)], pins)
        reached.append(float((found.positions - rest)[rest[:, 0].argmax(), 0]))
    assert 0.0 < reached[0] < reached[1] < reached[2] < 1.0 and reached[2] > 0.9


@pytest.mark.parametrize("count", [1, 2, 3])
def test_tiny_graphs(count):
    rest = cloud(6, count)
    graph = graph_of(rest)
    found = solve(graph, rest, [turn([0], 30, shift=(1, 0, 0))])
    assert np.isfinite(found.positions).all() and np.isfinite(found.rotations).all()
    np.testing.assert_allclose(found.positions[0], rotate(from_axis((0, 0, 1), 30), rest[0]) + X)


def test_everything_pinned_and_nothing_pinned():
    rest = cloud(7, 30)
    graph = graph_of(rest)
    held = solve(graph, rest, [turn([3], shift=(1, 0, 0))], range(30))
    np.testing.assert_allclose(held.positions[3], rest[3] + X)
    others = np.arange(30) != 3
    np.testing.assert_array_equal(held.positions[others], rest[others])
    none = solve(graph, rest, [])
    np.testing.assert_array_equal(none.positions, rest)


def test_pieces_without_a_handle_stay_to_the_bit():
    rest = np.concatenate([cloud(8, 40), cloud(9, 40) + 50 * X])
    graph = graph_of(rest)
    assert len(np.unique(graph.component)) >= 2
    found = solve(graph, rest, [turn([0, 1, 2], 40)])
    np.testing.assert_array_equal(found.positions[40:], rest[40:])
    assert np.abs(found.positions[:40] - rest[:40]).max() > 0.1


def test_points_on_one_another_and_far_away():
    rest = np.concatenate([cloud(10, 30), np.zeros((5, 3)), [[1e6, 0, 0]]])
    graph = graph_of(rest)
    found = solve(graph, rest, [turn([0], 20, shift=(1000.0, 0, 0))], [5, 6], steps=48)
    assert np.isfinite(found.positions).all() and np.linalg.det(found.rotations).min() > 0.99


@pytest.mark.parametrize("degrees", [45, 90, 135])
def test_a_limit_on_lengths_spreads_a_bend(degrees):
    """The edge that changes most changes by a quarter less."""
    rest = cloud(4, 160, (4.0, 0.4, 0.4))
    graph = graph_of(rest)
    right, left = np.flatnonzero(rest[:, 0] > 1.5), np.flatnonzero(rest[:, 0] < -1.5)
    goal, ends = turn(right, degrees, (0, 1, 0)), graph.edges.T
    steps, changes = count_steps(np.radians(degrees), 0.0, graph.edge_length), []
    for limit in (0.0, 15.0):
        posed = solve(graph, rest, [goal], left, steps, limit).positions
        sizes = [np.linalg.norm(x[ends[0]] - x[ends[1]], axis=1) for x in (rest, posed)]
        changes.append(np.abs(sizes[1] / sizes[0] - 1.0))
    assert changes[1].max() < 0.75 * changes[0].max()


@pytest.mark.parametrize("limit", [0.0, 15.0])
def test_same_bits_on_any_number_of_threads(all_threads, limit):
    rest = cloud(11, 700)
    graph = graph_of(rest)
    results = []
    for threads in (1, 2):
        environment.configure(threads=threads)
        found = solve(graph, rest, [turn(range(20), 60)], np.arange(300, 400), limit=limit)
        results.append((found.positions.tobytes(), found.rotations.tobytes()))
    assert results[0] == results[1]


BOUNDS = {
    "arm": {
        15: (0.08, 0.08, 0.95, 0.02),
        45: (0.23, 0.23, 0.85, 0.05),
        90: (0.41, 0.44, 0.65, 0.09),
        135: (0.51, 0.57, 0.3, 0.13),
    },
    "leg": {
        15: (0.05, 0.07, 0.9, 0.01),
        45: (0.13, 0.2, 0.6, 0.02),
        90: (0.235, 0.37, 0.15, 0.04),
        135: (0.35, 0.49, -0.25, 0.05),
    },
}
"""What was measured, and a fifth more: edges, Gaussians' neighbours, determinant, error (``limb_bending.Bent``)."""


@pytest.mark.parametrize("limb", sorted(LIMBS))
def test_a_limb_of_the_figure_turns_about_its_joint(limb):
    """With the figure's true motion, and a joint that is one ring shorter than that of docs/editing.md."""
    scene, _, bones = figure_scene(256)
    session = EditSession(scene)
    node_bones = np.array(scene.motion.bones)
    grab(session, node_bones, limb, near=1, far=3)
    everything = np.ones(len(bones), bool)
    found = {degrees: bend(session, node_bones, everything, bones, limb, degrees) for degrees in (15, 45, 90, 135)}
    limits = BOUNDS[limb]
    for degrees, bent in found.items():
        edges, gaussians, determinant, error = limits[degrees]
        assert bent.edges < edges and bent.gaussians < gaussians and bent.error < error, (degrees, bent)
        assert bent.determinant > determinant, (degrees, bent)
    for small, large in ((15, 45), (45, 90), (90, 135)):
        assert found[small].edges < found[large].edges


def test_a_pair_tied_by_one_edge_is_turned_no_further_than_it_has_to_be():
    """One edge leaves its own axis open."""
    rest = np.concatenate([cloud(16, 40), [[30.0, 1.0, 2.0], [30.3, 1.4, 2.2]]])
    graph = graph_of(rest)
    assert graph.component[40] == graph.component[41] != graph.component[0]
    solver = ArapSolver(graph)
    np.testing.assert_array_equal(from_matrix(solver.turns(rest, rest))[:, 1:] ** 2 < 1e-20, True)
    edge = rest[41] - rest[40]
    for degrees in (1e-5, 30.0, 179.0):
        axis = np.cross(edge, [0.0, 0.0, 1.0])
        least = from_axis(axis, degrees)
        posed = rest.copy()
        posed[41] = rest[40] + rotate(least, edge)
        np.testing.assert_allclose(from_matrix(solver.turns(rest, posed))[40:], [least, least], atol=1e-6)
    posed[41] = rest[40] - edge
    turned = solver.turns(rest, posed)[40:]
    np.testing.assert_allclose(np.linalg.det(turned), 1.0, atol=1e-9)


@pytest.mark.parametrize("other", ["turned", "soft", "hard"])
def test_a_solver_that_is_used_again_remembers_what_its_systems_depend_on(other):
    """Which nodes have a rotation of their own is part of the system, as much as which are held and how softly."""
    rest = cloud(4, 40)
    graph = graph_of(rest)
    held, none = np.arange(40) < 10, np.zeros(40)
    turns = np.tile(from_axis([0, 0, 1], 70), (40, 1))
    rotations = np.stack([rotate(turns, np.tile(axis, (40, 1))) for axis in np.eye(3)], axis=2)
    free = RigidGroups.none(40)
    posed = rest + 0.3 * np.random.default_rng(4).normal(size=rest.shape)
    first = Anchors(held, none, np.zeros(40, bool), posed, rotations, none, free)
    changes = {"turned": held, "soft": np.where(np.arange(40) == 30, 0.5, 0.0), "hard": np.arange(40) < 12}
    second = first._replace(**{other: changes[other]})
    used = ArapSolver(graph)
    used.relax(rest, first, Shape.at_rest(rest), 2)
    again = used.relax(rest, second, Shape.at_rest(rest), 2)
    fresh = ArapSolver(graph).relax(rest, second, Shape.at_rest(rest), 2)
    np.testing.assert_array_equal(again.positions, fresh.positions)
    np.testing.assert_array_equal(again.rotations, fresh.rotations)
    before = ArapSolver(graph).relax(rest, first, Shape.at_rest(rest), 2)
    assert np.abs(before.rotations - fresh.rotations).max() > 1e-3
