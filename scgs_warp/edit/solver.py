"""As-rigid-as-possible deformation: positions and rotations of all control points from anchors on some of them.

Local and global steps alternate (Sorkine & Alexa 2007): each node fits the rotation that best explains its edges,
regularised towards its neighbours' rotations (Levi & Gotsman 2015), then one sparse linear system gives all positions.
A projective spring on each edge preserves its length, because thin limbs hang on few edges and plain ARAP shears those
at a joint. A second one, where it is asked for, acts on large changes of length, and on edges that point elsewhere than
the rotations of their ends say: it spreads a bend over the edges of a joint instead of leaving most of it to a few. The
matrix depends on which nodes are held, not on where they are, and is factorised once per set of handles.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.sparse import csc_matrix, diags
from scipy.sparse.linalg import splu

from ..kernels import arap_solver as kernels
from ..runtime.launch import launch
from .graph import ControlGraph
from .rigid_groups import NO_LENGTHS, GroupRotations, GroupState, Lengths, RigidGroups
from .rotations import exponential, from_matrix, logarithm, to_matrix

SMOOTHNESS = 0.3
"""Weight of the neighbours' rotations, in squared edge lengths."""
STRETCH = 2.0
"""Weight of preserving an edge's length, relative to the ARAP energy."""
SHORTEST, LONGEST = 0.92, 1.05
"""Length of an edge that a limit on lengths allows, relative to that at rest. The inside of a joint has to give way: it
folds if no edge may be shorter."""
STEP_ANGLE = math.radians(15.0)
"""Largest turn of a handle between two solutions: beyond about 90 degrees the energy has other minima."""
STEP_LENGTH = 2.0
"""Largest shift of a handle between two solutions, in edge lengths."""
MAX_STEPS = 48
"""Largest number of sub-steps; a handle that is dragged very far takes longer ones."""
STEP_ITERATIONS = 6
FINAL_ITERATIONS = 60
FREE_ITERATIONS = 200
"""Replaces ``FINAL_ITERATIONS`` if a group turns freely, because a whole limb then swings into place."""
LIMITED_PACE = 2
"""Factor on all numbers of iterations with a limit on lengths, because each of them then makes less progress."""
TURN_ITERATIONS = 8
TOLERANCE = 1e-4
"""Convergence threshold in edge lengths: iterations stop when no node moves further in one iteration."""
CACHED_FACTORS = 16
"""Number of cached factorisations."""


class Anchors(NamedTuple):
    """Constraints on positions and rotations of M nodes."""

    hard: np.ndarray
    """[M] bool: the position is fixed."""
    soft: np.ndarray
    """[M] >= 0 weight that pulls a node to its position, relative to its edges; 0: no pull."""
    turned: np.ndarray
    """[M] bool: the rotation is fixed."""
    positions: np.ndarray
    """[M, 3], read only where ``hard`` or ``soft`` is set."""
    rotations: np.ndarray
    """[M, 3, 3], read only where ``turned`` or ``leaning`` is set."""
    leaning: np.ndarray
    """[M] >= 0 weight that pulls a node to its rotation, as ``soft`` does for positions."""
    groups: RigidGroups
    """Nodes that move as free rigid bodies; their positions and rotations above are not read."""

    def equals(self, other: Anchors) -> bool:
        return all(np.array_equal(a, b) for a, b in zip(self[:-1], other[:-1])) and self.groups.equals(other.groups)


@dataclass
class Shape:
    """State of the solver, from which the next solution starts."""

    positions: np.ndarray
    """[M, 3]"""
    rotations: np.ndarray
    """[M, 3, 3]"""
    anchors: Anchors | None = None
    """Anchors that led to this state."""

    @staticmethod
    def at_rest(rest: np.ndarray) -> Shape:
        return Shape(rest.copy(), np.tile(np.eye(3), (len(rest), 1, 1)))


class _System(NamedTuple):
    """Linear system for one set of held nodes, independent of their positions."""

    free: torch.Tensor
    """[F] int32 nodes with unknown position."""
    turning: torch.Tensor
    """[T] int32 nodes with unknown rotation."""
    fixed: torch.Tensor
    """[M] int32"""
    pulls: torch.Tensor
    """[M] float64"""
    factor: Any
    """SuperLU of the free nodes' Laplacian; None if there are none."""


class ArapSolver:
    """Solver for one graph, with cached factorisations. Float64 on the CPU; the same arguments give bit-identical
    results.

    Args:
        smoothness: weight of the neighbours' rotations, squared edge lengths.
        stretch: weight of preserving an edge's length, relative to the ARAP energy.
        limit: weight of changes of an edge's length beyond ``SHORTEST`` and ``LONGEST``, likewise; 0: none.

    Attributes: ``pace``, the factor on numbers of iterations.
    """

    def __init__(
        self, graph: ControlGraph, smoothness: float = SMOOTHNESS, stretch: float = STRETCH, limit: float = 0.0
    ) -> None:
        self.graph = graph
        self.smoothness, self._lengths = smoothness, Lengths(stretch, limit, SHORTEST, LONGEST)
        self.pace = LIMITED_PACE if limit > 0.0 else 1
        self._begin = torch.from_numpy(graph.begin)
        self._neighbors = torch.from_numpy(graph.neighbors)
        self._weights = torch.from_numpy(graph.weights)
        self._degree = np.asarray(graph.matrix.sum(1)).reshape(-1)
        self._systems: OrderedDict[bytes, _System] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the factorisations, which cannot be copied and are made anew."""
        return {**self.__dict__, "_systems": OrderedDict()}

    def _system(self, anchors: Anchors) -> _System:
        key = anchors.hard.tobytes() + anchors.turned.tobytes() + anchors.soft.tobytes()
        system = self._systems.get(key)
        if system is None:
            system = self._systems[key] = self._factorise(anchors)
            while len(self._systems) > CACHED_FACTORS:
                self._systems.popitem(last=False)
        self._systems.move_to_end(key)
        return system

    def _factorise(self, anchors: Anchors) -> _System:
        """Factorise the system of the free nodes. Components without anchors stay fixed."""
        component = self.graph.component
        held = anchors.hard | (anchors.soft > 0)
        alive = np.isin(component, np.unique(component[held]))
        free = alive & ~anchors.hard
        degree = self._degree
        pulls = np.where(free, anchors.soft * degree, 0.0)
        lone = free & (degree == 0)  # an isolated node moves to its soft target
        pulls[lone] = np.maximum(anchors.soft[lone], 1e-12)
        factor = None
        if free.any():
            laplacian = diags(degree + pulls) - self.graph.matrix
            inner = csc_matrix(laplacian.tocsr()[free][:, free])
            factor = splu(inner, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        return _System(
            torch.from_numpy(np.flatnonzero(free).astype(np.int32)),
            torch.from_numpy(np.flatnonzero(alive & ~anchors.turned).astype(np.int32)),
            torch.from_numpy((~free).astype(np.int32)),
            torch.from_numpy(pulls),
            factor,
        )

    def relax(self, rest: np.ndarray, anchors: Anchors, shape: Shape, iterations: int) -> Shape:
        """Take at most ``iterations`` local and global steps from ``shape`` towards the minimum.

        If anchors have moved, iterations start from a guess that spreads their turns smoothly between them and derives
        positions. For a component with a single handle the guess is the solution.

        Args:
            rest: [M, 3] float64 shape of zero energy, normalised units.
            anchors: constraints.
            shape: initial state; not modified.
        """
        system = self._system(anchors)
        start = torch.from_numpy(np.ascontiguousarray(rest))
        positions = np.where(anchors.hard[:, None], anchors.positions, shape.positions)
        groups = self._groups(system, anchors, rest)
        posed, rotations = torch.from_numpy(positions), torch.from_numpy(self._guess(system, anchors, shape, groups))
        targets = torch.from_numpy(anchors.positions.copy())
        asked = self._asked(anchors)
        spare = rotations.clone()
        groups.start(GroupState(positions, rotations.numpy(), targets.numpy(), asked[1].numpy()))
        edges = self._begin, self._neighbors, self._weights
        free = system.free.long().numpy()
        sums = torch.empty(len(free), 3, dtype=torch.float64)
        smooth = self.smoothness * self.graph.edge_length**2
        tolerance = TOLERANCE * self.graph.edge_length
        same = shape.anchors is not None and anchors.equals(shape.anchors)
        for step in range(1 if same else 0, iterations + 1):
            if step:
                inputs = system.turning, start, posed, *edges
                launch(kernels.turn_nodes, len(system.turning), *inputs, smooth, rotations, *asked, spare, grain=64)
                rotations, spare = spare, rotations
            if system.factor is None:
                break
            lengths = self._lengths if step else NO_LENGTHS  # edges of moved nodes have no valid direction yet
            inputs = system.free, system.fixed, start, posed, *edges, *lengths, rotations
            launch(kernels.edge_sums, len(free), *inputs, system.pulls, targets, sums, grain=128)
            before = positions.copy()
            positions[free] = system.factor.solve(sums.numpy())
            state = GroupState(positions, rotations.numpy(), targets.numpy(), asked[1].numpy())
            groups.turn(state, before, lengths)
            spare[groups.turned] = rotations[groups.turned]
            moved = float(np.abs(positions[free] - before[free]).max(initial=0.0))
            if step and not moved > tolerance:
                break
        return Shape(positions, rotations.numpy(), anchors)

    def _groups(self, system: _System, anchors: Anchors, rest: np.ndarray) -> GroupRotations:
        free = system.free.long().numpy()
        weights = self._lengths, self.smoothness * self.graph.edge_length**2
        return GroupRotations(
            self.graph, anchors.groups, rest, anchors.turned, free, system.factor, system.pulls.numpy(), *weights
        )

    def _asked(self, anchors: Anchors) -> tuple[torch.Tensor, torch.Tensor]:
        """Return weights [M] and values [M, 3, 3] of the rotations that nodes are pulled to."""
        weights = anchors.leaning * self._degree * self.graph.edge_length**2
        return torch.from_numpy(weights), torch.from_numpy(anchors.rotations.copy())

    def _guess(self, system: _System, anchors: Anchors, shape: Shape, groups: GroupRotations) -> np.ndarray:
        """Guess rotations [M, 3, 3]. Fixed rotations are those of the anchors; the others are those of ``shape``,
        turned by the harmonic interpolation of the anchors' turns since ``shape``."""
        told = anchors.turned & ~anchors.groups.members
        turns = np.where(told[:, None, None], anchors.rotations, shape.rotations)
        further = np.zeros((len(turns), 3))
        given = np.flatnonzero(anchors.turned)
        wanted = np.flatnonzero(told | ((anchors.leaning > 0) & ~anchors.groups.members))
        change = anchors.rotations[wanted] @ shape.rotations[wanted].transpose(0, 2, 1)
        further[wanted] = logarithm(from_matrix(change))
        if system.factor is None or not further.any():
            return turns
        free = system.free.long().numpy()
        pulls = system.pulls.numpy()[:, None]
        held = np.where(anchors.hard[:, None], further, 0.0)
        sums = (self.graph.matrix @ held) + pulls * further
        further[free] = system.factor.solve(np.ascontiguousarray(sums[free]))
        if len(groups.rotations):
            groups.spread_turns(self.graph, further, system.factor)
            given = np.flatnonzero(told)
            free = np.union1d(free, groups.turned)
        turning = np.setdiff1d(free, given)
        turns[turning] = to_matrix(exponential(further[turning])) @ turns[turning]
        return turns

    def solve(self, rest: np.ndarray, path: Callable[[float], Anchors], steps: int) -> Shape:
        """Follow a path of anchors from rest and return the deformation at its end. The result depends on the arguments
        alone.

        Args:
            rest: [M, 3] float64, normalised units.
            path: maps the share of the path, 0 to 1, to anchors, always on the same nodes.
            steps: number of sub-steps, from ``count_steps``.
        """
        shape = Shape.at_rest(rest)
        for step in range(1, steps + 1):
            last = step == steps
            anchors = path(step / steps)
            final = FREE_ITERATIONS if len(anchors.groups.centers) else FINAL_ITERATIONS
            shape = self.relax(rest, anchors, shape, self.pace * (final if last else STEP_ITERATIONS))
        return shape

    def turns(self, rest: np.ndarray, posed: np.ndarray) -> np.ndarray:
        """Estimate the rotation of each node, [M, 3, 3], from its edges, regularised by its neighbours' rotations."""
        nodes = torch.arange(len(rest), dtype=torch.int32)
        inputs = nodes, *(torch.from_numpy(np.ascontiguousarray(x)) for x in (rest, posed))
        edges = self._begin, self._neighbors, self._weights
        rotations = torch.from_numpy(np.tile(np.eye(3), (len(rest), 1, 1)))
        spare = rotations.clone()
        none = torch.zeros(len(rest), dtype=torch.float64), rotations
        for step in range(TURN_ITERATIONS):
            smooth = self.smoothness * self.graph.edge_length**2 if step else 0.0  # neighbours have no estimate yet
            launch(kernels.turn_nodes, len(rest), *inputs, *edges, smooth, rotations, *none, spare, grain=64)
            rotations, spare = spare, rotations
        return rotations.numpy()

    def poisson(self, rest: np.ndarray, rotations: np.ndarray, held: np.ndarray) -> np.ndarray:
        """Solve for positions [M, 3] whose edges are those of ``rest`` turned by ``rotations`` [M, 3, 3], with nodes
        ``held`` [M] fixed. In a component without held nodes the first node is fixed."""
        graph = self.graph
        own = np.repeat(np.arange(len(graph)), np.diff(graph.begin))
        edges = rest[own] - rest[graph.neighbors]
        wanted = np.einsum("eij,ej->ei", 0.5 * (rotations[own] + rotations[graph.neighbors]), edges)
        hard, none = held.copy(), np.zeros(len(graph))
        free_components = np.setdiff1d(graph.component, graph.component[held])
        labels, first = np.unique(graph.component, return_index=True)
        hard[first[np.isin(labels, free_components)]] = True
        system = self._system(Anchors(hard, none, ~hard, rest, rotations, none, RigidGroups.none(len(graph))))
        positions = rest.copy()
        free = system.free.long().numpy()
        if system.factor is not None:
            sums = np.zeros_like(rest)
            known = np.where(hard[graph.neighbors, None], rest[graph.neighbors], 0.0)
            np.add.at(sums, own, graph.weights[:, None] * (wanted + known))
            positions[free] = system.factor.solve(sums[free])
        return positions


def count_steps(angle: float, distance: float, edge_length: float) -> int:
    """Return the number of sub-steps for a handle that turns by ``angle`` (radians) and moves by ``distance``."""
    wanted = max(angle / STEP_ANGLE, distance / (STEP_LENGTH * edge_length))
    return min(MAX_STEPS, max(1, math.ceil(wanted - 1e-9))) if math.isfinite(wanted) else MAX_STEPS
