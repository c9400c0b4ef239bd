"""Groups of control points that move as free rigid bodies: their pivots are given, their rotations are solved for.

For fixed rotations of all other nodes, the energy of the global step is quadratic in the positions of the free nodes
and in the group's rotation matrix R. After elimination of the positions it is ``tr(R Q R^T) + 2 <G - R0 Q, R>`` plus a
constant, where R0 is the present rotation and G the gradient there. The first term is the same for all rotations, so
that the minimum is the rotation nearest to ``R0 Q - G`` (Procrustes). Each iteration therefore takes the best rotation
and the best positions together, and a group turns as fast as its surroundings converge.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from .graph import ControlGraph


class RigidGroups(NamedTuple):
    """Groups whose nodes are at ``center + R arm``, each with a rotation R of its own that the solver finds."""

    label: np.ndarray
    """[M] int64 group of each node; -1: none."""
    arms: np.ndarray
    """[M, 3] offsets of the nodes from their group's pivot at rest, read where ``label`` is at least 0."""
    centers: np.ndarray
    """[G, 3] where the pivots go."""

    @staticmethod
    def none(count: int) -> RigidGroups:
        return RigidGroups(np.full(count, -1, np.int64), np.zeros((count, 3)), np.zeros((0, 3)))

    @property
    def members(self) -> np.ndarray:
        """[M] bool"""
        return self.label >= 0

    def equals(self, other: RigidGroups) -> bool:
        return all(np.array_equal(mine, others) for mine, others in zip(self, other))


class Lengths(NamedTuple):
    """Weights of keeping the lengths of edges (kernels/arap_solver.py), relative to that of keeping their shape."""

    stretch: float
    """Weight of any change of length."""
    limit: float
    """Weight of the change beyond the two lengths below."""
    shortest: float
    """Least length that the limit allows, relative to that at rest."""
    longest: float
    """Largest one."""

    @property
    def total(self) -> float:
        """Weight in the linear system, that of the shape included."""
        return 1.0 + self.stretch + 0.5 * self.limit


NO_LENGTHS = Lengths(0.0, 0.0, 1.0, 1.0)


class GroupState(NamedTuple):
    """Arrays of the solver that groups read and write in place."""

    positions: np.ndarray
    """[M, 3]"""
    rotations: np.ndarray
    """[M, 3, 3]"""
    targets: np.ndarray
    """[M, 3] of nodes that are pulled to a position."""
    asked: np.ndarray
    """[M, 3, 3] of nodes that are pulled to a rotation."""


class _Spread(NamedTuple):
    """One group's share of the linear system, for one rest shape."""

    fixed: np.ndarray
    """[n] members whose positions are fixed."""
    pulled: np.ndarray
    """[P] members that are pulled to their places instead."""
    turned: np.ndarray
    """[T] members that have the group's rotation; the others are at most pulled to it."""
    first: np.ndarray
    """[B] one end of each edge whose energy depends on R."""
    second: np.ndarray
    """[B] other end."""
    weights: np.ndarray
    """[B]"""
    levers: np.ndarray
    """[B, 3] derivative of the edges' mismatch with respect to R: it changes by ``dR @ lever``."""
    around: tuple[np.ndarray, np.ndarray]
    """Neighbours of the group, once for each edge, and the edges' weights."""
    moved: np.ndarray
    """[F, 3] derivative of the free positions with respect to R: they change by ``moved @ dR^T``."""
    inertia: np.ndarray
    """[3, 3] Q."""


class GroupRotations:
    """Rotations [G, 3, 3] of all groups during one relaxation.

    Args:
        groups: all of them; a member is fixed (and not free) or pulled (and free).
        rest: [M, 3]
        turned: [M] bool, members that have their group's rotation.
        free: [F] nodes with unknown position.
        factor: factorisation of their Laplacian; None without free nodes.
        pulls: [M] weights of soft targets.
        lengths: weights of preserving the lengths of edges.
        smooth: weight of a neighbour's rotation, squared units of the positions.
    """

    def __init__(
        self,
        graph: ControlGraph,
        groups: RigidGroups,
        rest: np.ndarray,
        turned: np.ndarray,
        free: np.ndarray,
        factor: Any,
        pulls: np.ndarray,
        lengths: Lengths,
        smooth: float,
    ) -> None:
        self.groups, self.rest, self.free, self.pulls = groups, rest, free, pulls
        self.lengths, self.smooth = lengths, smooth
        self.rotations = np.tile(np.eye(3), (len(groups.centers), 1, 1))
        self.turned = np.flatnonzero(groups.members & turned)
        self._spreads: list[_Spread] = []
        if not len(groups.centers):
            return
        self._ends = tuple(graph.edges.T)
        self._weights = np.asarray(graph.matrix[self._ends]).reshape(-1)
        row = np.full(len(graph), -1, np.int64)
        row[free] = np.arange(len(free))
        self._spreads = [self._spread(group, row, factor) for group in range(len(groups.centers))]

    def _spread(self, group: int, row: np.ndarray, factor: Any) -> _Spread:
        label, arms = self.groups.label, self.groups.arms
        member = label == group
        inside = member & (row < 0)
        fixed, pulled = np.flatnonzero(inside), np.flatnonzero(member & ~inside)
        i, j = self._ends
        touched = (member[i] | member[j]) & ~(inside[i] & inside[j])
        i, j, weights = i[touched], j[touched], self._weights[touched]
        positions = inside[i, None] * arms[i] - inside[j, None] * arms[j]
        turning = 0.5 * (member[i].astype(float) + member[j])[:, None] / self.lengths.total
        levers = positions - turning * (self.rest[i] - self.rest[j])
        sums = np.zeros((len(row), 3))
        np.add.at(sums, i, -weights[:, None] * levers)
        np.add.at(sums, j, weights[:, None] * levers)
        sums[pulled] += self.pulls[pulled, None] * arms[pulled]
        sums = np.ascontiguousarray(sums[self.free])
        moved = factor.solve(sums) if factor is not None and sums.any() else np.zeros_like(sums)
        inertia = np.einsum("b,bi,bj->ij", weights, levers, levers) - moved.T @ sums
        inertia += np.einsum("p,pi,pj->ij", self.pulls[pulled], arms[pulled], arms[pulled])
        turned = self.turned[member[self.turned]]
        leaving = member[i] != member[j]
        around = np.where(member[i], j, i)[leaving], weights[leaving]
        return _Spread(fixed, pulled, turned, i, j, weights, levers, around, moved, inertia)

    def spread_turns(self, graph: ControlGraph, further: np.ndarray, factor: Any) -> None:
        """Give groups, and the free nodes with them, the turns that follow smoothly from those of all other handles.

        Args:
            further: [M, 3] rotation vectors: those of all fixed nodes, and their harmonic interpolation at the free
                nodes, with 0 at the groups; updated.
        """
        fixed, pulled = np.zeros((2, len(further), len(self._spreads)))
        for group, spread in enumerate(self._spreads):
            fixed[spread.fixed, group] = 1.0
            pulled[spread.pulled, group] = self.pulls[spread.pulled]
        share = fixed.copy()
        if factor is not None:
            share[self.free] = factor.solve(np.ascontiguousarray((graph.matrix @ fixed + pulled)[self.free]))
        degree = np.asarray(graph.matrix.sum(1))

        def torque(turns: np.ndarray) -> np.ndarray:
            return fixed.T @ (degree * turns - graph.matrix @ turns) - pulled.T @ turns

        flux = torque(share) + np.diag(pulled.sum(0))
        further += share @ np.linalg.lstsq(flux, -torque(further), rcond=1e-9)[0]

    def start(self, state: GroupState) -> None:
        """Take the present rotation of each group: that of its fixed nodes, or else the one that fits the positions of
        its pulled nodes. Then place the groups."""
        for group, spread in enumerate(self._spreads):
            fixed = spread.fixed
            if len(fixed):
                self.rotations[group] = state.rotations[fixed[0]]
            elif len(spread.pulled):
                arms, now = self.groups.arms[spread.pulled], state.positions[spread.pulled]
                fit = (now - now.mean(0)).T @ (arms - arms.mean(0))
                self.rotations[group] = nearest_rotation(fit, np.eye(3))
            self._place(group, state)

    def _place(self, group: int, state: GroupState) -> None:
        spread, turn, center = self._spreads[group], self.rotations[group], self.groups.centers[group]
        state.positions[spread.fixed] = center + self.groups.arms[spread.fixed] @ turn.T
        state.targets[spread.pulled] = center + self.groups.arms[spread.pulled] @ turn.T
        state.rotations[spread.turned] = turn
        state.asked[spread.pulled] = turn

    def turn(self, state: GroupState, before: np.ndarray, lengths: Lengths) -> None:
        """Turn every group, one after the other, and move the free nodes with it.

        Args:
            state: its positions are the solution of the linear system for its rotations; updated.
            before: [M, 3] positions from which its right-hand side was computed.
            lengths: weights of preserving the lengths of edges in that right-hand side.
        """
        for group, spread in enumerate(self._spreads):
            old = self.rotations[group].copy()
            missing = self._missing(spread, state, before, lengths)
            slope = np.einsum("b,bi,bj->ij", spread.weights, missing, spread.levers)
            lag = state.targets[spread.pulled] - state.positions[spread.pulled]
            slope += np.einsum("p,pi,pj->ij", self.pulls[spread.pulled], lag, self.groups.arms[spread.pulled])
            nodes, weights = spread.around
            around = self.smooth * np.einsum("b,bij->ij", weights, state.rotations[nodes])
            self.rotations[group] = nearest_rotation(old @ spread.inertia - slope + around, old)
            state.positions[self.free] += spread.moved @ (self.rotations[group] - old).T
            self._place(group, state)

    def _missing(self, spread: _Spread, state: GroupState, before: np.ndarray, lengths: Lengths) -> np.ndarray:
        """Return the mismatch between edges and those that the energy asks for, [B, 3]."""
        i, j = spread.first, spread.second
        edges = self.rest[i] - self.rest[j]
        wanted = 0.5 * np.einsum("bij,bj->bi", state.rotations[i] + state.rotations[j], edges)
        posed = before[i] - before[j]
        size = np.maximum(np.linalg.norm(posed, axis=1, keepdims=True), 1e-300)
        cosine = (posed * wanted).sum(1, keepdims=True) / np.maximum(
            size * np.linalg.norm(wanted, axis=1, keepdims=True), 1e-300
        )
        along = cosine.clip(0.0, 1.0)
        old = np.linalg.norm(edges, axis=1, keepdims=True)
        kept = along * old / size * posed + (1.0 - along) * wanted
        near = size.clip(lengths.shortest * old, lengths.longest * old)
        allowed = along * near / size * posed + (1.0 - along) * wanted
        asked = wanted + lengths.stretch * kept + lengths.limit * (allowed - 0.5 * posed)
        return state.positions[i] - state.positions[j] - asked / lengths.total


def nearest_rotation(matrix: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to a matrix [3, 3]; of several that are equally near, one close to ``otherwise``."""
    size = np.abs(matrix).max()
    if not size > 1e-60:
        return otherwise
    U, _, Vt = np.linalg.svd(matrix / size + 1e-9 * otherwise)
    U[:, 2] *= 1.0 if np.linalg.det(U) * np.linalg.det(Vt) > 0 else -1.0
    return U @ Vt
