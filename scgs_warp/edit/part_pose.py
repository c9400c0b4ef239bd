"""Poses of parts: forward kinematics from the turns of joints to goals of the solver.

Parts between which no joint is turned move as one rigid body. The solver holds a body's control points where the
skeleton puts them, except those of the rings next to another body, which are free: there the surface bends over several
edges of the graph instead of one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from .graph import ControlGraph
from .handles import MIN_NODES_FOR_FRAME, Goal, Handle, Target
from .rotations import IDENTITY, conjugate, multiply, power, rigid_fit, rotate
from .skeleton import Skeleton
from .solver import ArapSolver

FREE_RINGS = 3
"""Number of rings of control points on either side of a turned joint that are free; fewer on a short part, so that some
of its control points are held."""
HELD_SHARE = 0.25
"""Least share of a body's control points that are held: a single one beyond the free rings would not turn the body."""
INNER_STIFFNESS = 0.03
"""Stiffness (edges have 1) with which a short body between two others is pulled to its place. The bodies at its ends
place it already; held firmly, it would leave the surface little room to bend."""
LENGTH_LIMIT = 10.0
"""Weight of changes of an edge's length beyond what is allowed (``ArapSolver``), relative to the ARAP energy: all free
edges of a joint share a bend."""
BOUNDARY_REACH = 1.5
"""Distance of an edge from the joint of the parts that it connects, relative to the median of all their edges, beyond
which it bridges a gap and is cut: an arm that hung beside the trunk shares Gaussians with it."""
MIN_TURN = 1e-3
"""Angle in radians below which the path of a body is a straight line rather than an arc."""


class Rigid(NamedTuple):
    """Rigid motion ``x -> R x + shift``, normalised units."""

    quat: np.ndarray
    """[4] of R."""
    shift: np.ndarray
    """[3]"""

    @staticmethod
    def none() -> Rigid:
        return Rigid(IDENTITY, np.zeros(3))

    def after(self, first: Rigid) -> Rigid:
        """Return the motion that applies ``first``, then this one."""
        return Rigid(multiply(self.quat, first.quat), rotate(self.quat, first.shift) + self.shift)

    def apply(self, points: np.ndarray) -> np.ndarray:
        return rotate(self.quat, points) + self.shift

    def undo(self, points: np.ndarray) -> np.ndarray:
        """Return the points that this motion takes to ``points``."""
        return rotate(conjugate(self.quat), points - self.shift)


class PartMove(NamedTuple):
    """Handle of a part with its target at one instant."""

    handle: Handle
    target: Target
    share: float
    """Share of the target that applies."""
    then: np.ndarray
    """[M, 3] control points at the handle's time, without handles."""


class JointFrame(NamedTuple):
    """A part's joint at one instant of the motion, before any part is turned; normalised units."""

    joint: np.ndarray
    """[3]"""
    frame: np.ndarray
    """[4] rotation of the parent between the handle's time and the instant, in whose frame the target is given."""


class PartPoser:
    """Poser of one skeleton.

    Args:
        skeleton: parts that hold all control points of the graph.
        graph: graph of the control points.
        start: [M, 3] control points at time 0, normalised units.
        units: (centre, scale) of the normalised scene.

    Attributes: ``graph`` without edges across gaps between parts, and its ``solver``.
    """

    def __init__(
        self, skeleton: Skeleton, graph: ControlGraph, start: np.ndarray, units: tuple[np.ndarray, float]
    ) -> None:
        self.skeleton, self.start, self.units = skeleton, start, units
        self.owner = skeleton.owners()
        self.rows = {part.name: row for row, part in enumerate(skeleton.parts)}
        roots = [part.name for part in skeleton.parts if part.parent is None]
        self._order = [self.rows[name] for root in roots for name in skeleton.branch(root)]
        self._parent = [-1 if part.parent is None else self.rows[part.parent] for part in skeleton.parts]
        centre, scale = units
        self.joints = (np.array([part.joint for part in skeleton.parts]) - centre) * scale
        self.graph = _without_bridges(graph, self.owner, self._parent, self.joints, start)
        self.solver = ArapSolver(self.graph, limit=LENGTH_LIMIT)
        self._jointed = _within_joints(self.graph, self.owner, self._parent)
        self._members = [self._with_surroundings(row) for row in range(len(skeleton.parts))]
        self._held: dict[tuple[int, ...], tuple[np.ndarray, frozenset[int]]] = {}

    def _with_surroundings(self, row: int) -> np.ndarray:
        """Return the part's control points, and their neighbours if they alone show no rotation."""
        own = np.flatnonzero(self.owner == row)
        return own if len(own) >= MIN_NODES_FOR_FRAME else np.array(self.graph.ring(own, 1))

    def joint_frame(self, handle: Handle, then: np.ndarray, now: np.ndarray) -> JointFrame:
        """Carry a part's joint, and the frame of its target, from the handle's time to another instant.

        Args:
            then, now: [M, 3] control points at the two times, without handles.
        """
        row = self.rows[handle.part or ""]
        own = self._members[row]
        lead = self._members[self._parent[row]] if self._parent[row] >= 0 else own
        if handle.pivot is None:
            joint, since = self.joints[row], self.start
        else:
            joint, since = (np.array(handle.pivot) - self.units[0]) * self.units[1], then
        frame = IDENTITY if now is then else rigid_fit(then[lead], now[lead])[0]
        if since is not now and not np.array_equal(since[own], now[own]):
            turn, before, after = rigid_fit(since[own], now[own])
            joint = rotate(turn, joint - before) + after
        return JointFrame(joint, frame)

    def motions(self, moves: Sequence[PartMove], now: np.ndarray) -> tuple[list[Rigid], list[int]]:
        """Return the rigid motion of each part, and the number of the body to which it belongs: the row of its topmost
        part, or -1 for parts that stay where they are."""
        local: dict[int, Rigid] = {}
        for move in moves:
            joint, frame = self.joint_frame(move.handle, move.then, now)
            quat = power(np.array(move.target.rotation), move.share)
            if quat[1:].any():
                quat = multiply(multiply(frame, quat), conjugate(frame))
            shift = rotate(frame, move.share * self.units[1] * np.array(move.target.translation))
            row = self.rows[move.handle.part or ""]
            if quat[1:].any() or shift.any():
                local[row] = Rigid(quat, joint + shift - rotate(quat, joint))
            else:
                local.pop(row, None)
        found, body = [Rigid.none()] * len(self._parent), [-1] * len(self._parent)
        for row in self._order:
            above = self._parent[row]
            found[row] = Rigid.none() if above < 0 else found[above]
            body[row] = -1 if above < 0 else body[above]
            if row in local:
                found[row], body[row] = found[row].after(local[row]), row
        return found, body

    def goals(self, moves: Sequence[PartMove], now: np.ndarray, released: np.ndarray) -> list[Goal]:
        """Return the goals of all bodies, none if every part stays where it is.

        Args:
            moves: handles of parts; of two on one part, the later one counts.
            now: [M, 3] control points at the instant, without handles.
            released: [M] bool, control points near other handles, which are left free.
        """
        motions, body = self.motions(moves, now)
        if max(body) < 0:
            return []
        handles = {self.rows[move.handle.part or ""]: move.handle for move in moves}
        of_node, goals = np.array(body)[self.owner], []
        held, short = self._held_nodes(body)
        for label in sorted(set(body)):
            nodes = np.flatnonzero(held & (of_node == label) & ~released)
            if not len(nodes):
                continue
            goal = _goal(nodes, motions[label] if label >= 0 else Rigid.none(), now)
            if label in short and self._carries(label, body):
                goal = goal._replace(stiffness=INNER_STIFFNESS, gives_rotation=False)
            goals.append(_as_asked(goal, handles[label]) if label >= 0 else goal)
        return goals

    def _carries(self, label: int, body: Sequence[int]) -> bool:
        """Return whether another moved body hangs on this one."""
        return label >= 0 and any(
            other >= 0 and self._parent[other] >= 0 and body[self._parent[other]] == label
            for other in set(body) - {label}
        )

    def _held_nodes(self, body: Sequence[int]) -> tuple[np.ndarray, frozenset[int]]:
        """Return which control points are held, [M] bool: those more than ``FREE_RINGS`` from every other body, and of
        a body that has few of these, those furthest away. Also return the bodies that have none."""
        key = tuple(body)
        found = self._held.get(key)
        if found is None:
            of_node = np.array(body)[self.owner]
            rings = _rings_to_others(self.graph, of_node, self._jointed, FREE_RINGS + 1)
            held, short = np.zeros(len(of_node), bool), set()
            for label in set(body):
                own = of_node == label
                most = int(rings[own].max())
                held |= own & (rings >= np.quantile(rings[own], 1.0 - HELD_SHARE, method="lower"))
                short |= {label} if most <= FREE_RINGS else set()
            if len(self._held) >= 64:
                self._held.clear()
            found = self._held[key] = held, frozenset(short)
        return found


def _as_asked(goal: Goal, handle: Handle) -> Goal:
    """Return the goal of the body that a handle turns, with the handle's stiffness and turns where it states them."""
    stiffness = goal.stiffness if handle.stiffness is None else handle.stiffness
    return goal._replace(
        stiffness=stiffness, gives_rotation=goal.gives_rotation if handle.turns is None else handle.turns
    )


def _goal(nodes: np.ndarray, motion: Rigid, now: np.ndarray) -> Goal:
    """Return the goal of a body. It moves on a screw: about the axis that its motion leaves in place, and along it."""
    quat, shift = motion
    sine = float(np.linalg.norm(quat[1:]))
    if 2.0 * sine < MIN_TURN:
        pivot = now[nodes].mean(0)
    else:
        axis = quat[1:] / sine
        across = shift - (shift @ axis) * axis
        pivot = 0.5 * (across + (quat[0] / sine) * np.cross(axis, across))
    return Goal(nodes, pivot, quat, shift + rotate(quat, pivot) - pivot)


def _within_joints(graph: ControlGraph, owner: np.ndarray, parent: Sequence[int]) -> np.ndarray:
    """Return which neighbours belong to the same part or to one with a common joint, [2 E] bool in the order of
    ``graph.neighbors``."""
    above, a, b = np.array(parent), np.repeat(owner, np.diff(graph.begin)), owner[graph.neighbors]
    return (a == b) | (above[a] == b) | (above[b] == a)


def _rings_to_others(graph: ControlGraph, label: np.ndarray, jointed: np.ndarray, most: int) -> np.ndarray:
    """Return the number of edges to the nearest control point of another label, [M], at most ``most``.

    Args:
        jointed: [2 E] bool, edges that count, in the order of ``graph.neighbors``. An edge that bridges a gap, because
            without it a piece would be connected to nothing, bends no joint.
    """
    own = np.repeat(np.arange(len(label)), np.diff(graph.begin))[jointed]
    other = graph.neighbors[jointed]
    same = label[own] == label[other]
    rings = np.full(len(label), most, np.int64)
    rings[own[~same]] = 1
    own, other = own[same], other[same]
    for ring in range(2, most):
        near = own[rings[other] == ring - 1]
        rings[near] = np.minimum(rings[near], ring)
    return rings


def _without_bridges(
    graph: ControlGraph, owner: np.ndarray, parent: Sequence[int], joints: np.ndarray, start: np.ndarray
) -> ControlGraph:
    """Cut edges between parts that have no common joint or that are far from it, unless a component would fall apart;
    then those nearest to a joint stay."""
    edges = graph.edges
    a, b = owner[edges].T
    above = np.array(parent)
    child = np.where(above[a] == b, a, np.where(above[b] == a, b, -1))
    away = np.linalg.norm(start[edges].mean(1) - joints[child], axis=1)
    away[(a != b) & (child < 0)] = np.inf
    keep = a == b
    for row in np.unique(child[(a != b) & (child >= 0)]):
        across = (a != b) & (child == row)
        keep |= across & (away <= BOUNDARY_REACH * np.median(away[across]))
    kept = edges[keep]
    inside = coo_matrix((np.ones(len(kept)), (kept[:, 0], kept[:, 1])), shape=(len(graph), len(graph)))
    piece = connected_components(inside, directed=False)[1]
    for row in np.flatnonzero(~keep)[np.argsort(away[~keep], kind="stable")]:
        first, second = piece[edges[row]]
        if first != second:
            piece[piece == second] = first
            keep[row] = True
    if keep.all():
        return graph
    ends = np.concatenate([edges[keep], edges[keep][:, ::-1]])
    matrix = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(graph), len(graph))).tocsr()
    matrix.sort_indices()
    return dataclasses.replace(
        graph,
        begin=matrix.indptr.astype(np.int32),
        neighbors=matrix.indices.astype(np.int32),
        weights=matrix.data.astype(np.float64),
    )
