"""Playing of a scene's control points with holds and exaggeration, before handles bend them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .graph import ControlGraph
from .handles import Goal, anchors_at
from .playback import Exaggerate, Hold
from .pose import MotionPose, NodePose
from .rotations import IDENTITY, conjugate, from_matrix, mean, multiply, power, rigid_fit, rotate, to_matrix
from .solver import ArapSolver, count_steps

MEAN_TIMES = 16
"""Number of instants over which the mean pose is taken."""


class Player:
    """Player of control points with holds and exaggeration; results depend on the arguments alone."""

    def __init__(self, graph: ControlGraph, solver: ArapSolver, motion_at: Callable[[float], MotionPose]) -> None:
        self.graph, self.solver, self.motion_at = graph, solver, motion_at
        self._mean: tuple[np.ndarray, np.ndarray] | None = None

    def play(self, time: float, holds: tuple[Hold, ...], exaggerate: Exaggerate | None) -> NodePose:
        """Return the control points at a scene time: exaggerated, then held."""
        now = self._exaggerated(time, exaggerate)
        active = [hold for hold in holds if hold.time != time]
        if not active:
            return now
        rest = now.positions
        near = np.zeros(len(rest), bool)
        for hold in holds:
            near[list(self.graph.with_strays(self.graph.ring(hold.nodes, hold.rings)))] = True
        pins = np.flatnonzero(~near)
        goals, color_turns_of = [], []
        for hold in holds:
            goal, color_turns = self._goal(hold, time, now, exaggerate)
            goals.append(goal)
            color_turns_of.append(color_turns)
        sweeps = [goal.sweep() for goal in goals]
        steps = max(count_steps(turned, moved, self.graph.edge_length) for turned, moved in sweeps)
        shape = self.solver.solve(rest, lambda share: anchors_at(goals, pins, rest, share), steps)
        held = ~near
        for goal in goals:
            held[goal.nodes] = True
        positions, turns = self.graph.follow(rest, shape.positions, from_matrix(shape.rotations), held)
        color_turns = turns.copy()
        for goal, own in zip(goals, color_turns_of):
            color_turns[goal.nodes] = own
        return now.then(positions, turns, color_turns)

    def _goal(self, hold: Hold, time: float, now: NodePose, exaggerate: Exaggerate | None) -> tuple[Goal, np.ndarray]:
        """Return the goal of a held region with the strays that follow it, and the turns of its colours, [n, 4]."""
        nodes = np.array(self.graph.with_strays(hold.nodes), np.int64)
        still = np.tile(IDENTITY, (len(nodes), 1))
        if hold.time == time:
            return Goal(nodes, np.zeros(3), IDENTITY, np.zeros(3)), still
        then = self._exaggerated(hold.time, exaggerate)
        body, before, after = IDENTITY, np.zeros(3), np.zeros(3)
        around = sorted(set(self.graph.ring(hold.nodes, hold.rings + 1)) - set(hold.nodes))
        if hold.frame == "body" and around:
            body, before, after = rigid_fit(then.positions[around], now.positions[around])
        target = rotate(body, then.positions[nodes] - before) + after
        quat, centre, moved = rigid_fit(now.positions[nodes], target)
        residual = target - (rotate(quat, now.positions[nodes] - centre) + moved)
        # The trained rotation at the hold's time, carried by the body, replaces the present trained rotation.
        trained = multiply(self.motion_at(hold.time).rotations[nodes], conjugate(self.motion_at(time).rotations[nodes]))
        total = multiply(body, multiply(multiply(then.turns[nodes], trained), conjugate(now.turns[nodes])))
        color_turns = multiply(body, multiply(then.color_turns[nodes], conjugate(now.color_turns[nodes])))
        own = multiply(conjugate(quat), total)
        return Goal(nodes, centre, quat, moved - centre, residual=residual, own_turns=own), color_turns

    def _exaggerated(self, time: float, exaggerate: Exaggerate | None) -> NodePose:
        """Scale every turn; positions follow from the turned edges, so that limbs keep their length."""
        here = self.motion_at(time).positions
        if exaggerate is None or exaggerate.factor == 1.0:
            return NodePose.of(here)
        middle, turn = self._mean_pose() if exaggerate.about is None else self._turned(exaggerate.about)
        further = power(multiply(self._turned(time)[1], conjugate(turn)), exaggerate.factor - 1.0)
        held = np.zeros(len(here), bool)
        if exaggerate.nodes:
            held[:] = True
            held[list(exaggerate.nodes)] = False
            further[held] = IDENTITY
        positions = self.solver.poisson(here, to_matrix(further), held)
        component = self.graph.component
        for label in np.setdiff1d(component, component[held]):
            members = component == label
            from_middle = here[members].mean(0) - middle[members].mean(0)
            centre = middle[members].mean(0) + exaggerate.factor * from_middle
            positions[members] += centre - positions[members].mean(0)
        positions, further = self.graph.follow(here, positions, further, np.zeros(len(here), bool))
        return NodePose.of(here).then(positions, further)

    def _turned(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [M, 3] at a time, and rotations [M, 4] since time 0 estimated from positions, which are
        smoother than the trained ones."""
        here = self.motion_at(time).positions
        return here, from_matrix(self.solver.turns(self.motion_at(0.0).positions, here))

    def _mean_pose(self) -> tuple[np.ndarray, np.ndarray]:
        if self._mean is None:
            poses = [self._turned(float(time)) for time in np.linspace(0.0, 1.0, MEAN_TIMES)]
            self._mean = np.mean([p for p, _ in poses], axis=0), mean(np.stack([q for _, q in poses]))
        return self._mean
