"""An edit, applied: which control points are where at any time, and the Gaussians that follow. Pure but for caches:
the same edit gives the same bits, in whatever order times are asked for; only ``live`` results depend on the way."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import torch

from ..errors import UserError
from ..motion.static import Static
from ..scene.from_gaussians import with_control_points
from ..scene.scene import Scene
from ..types import Gaussians
from .document import Edit
from .graph import ControlGraph, build_graph, sample_times
from .handles import ONE_FRAME, STAY, Goal, Target, anchors_at, carried_goal
from .keyframes import targets_at
from .player import Player
from .pose import MotionPose, NodePose, Rig, motion_pose, pose_gaussians
from .rotations import from_matrix, slerp, unit
from .solver import STEP_ITERATIONS, ArapSolver, Shape, count_steps

CACHED = 64
"""Instants whose control points are remembered."""
LIVE_STEPS = 4
"""Sub-steps that one drag update takes at most; a drag further than that catches up with the next updates."""
LIVE_ITERATIONS = 8

OPAQUE = 0.1
"""Gaussians of less opacity tie no control points together."""

Value = TypeVar("Value")


class _Problem(NamedTuple):
    """What is to be solved at one instant."""

    base: NodePose
    goals: list[Goal]
    pins: np.ndarray
    stay: np.ndarray
    """[M] bool: control points that follow nobody, as they are pinned or held."""


class _Live(NamedTuple):
    """Where the last live solution stands."""

    key: Any
    targets: dict[str, Target]
    shape: Shape


class Engine:
    """Bends one scene's control points. ``scene`` may have been given control points of its own (static scenes)."""

    def __init__(self, scene: Scene) -> None:
        if isinstance(scene.motion, Static):
            scene = with_control_points(scene)
        if not hasattr(scene.motion, "apply_pose") or not len(getattr(scene.motion, "positions", ())):
            raise UserError(
                f"the motion model {scene.motion_name!r} has no control points to take hold of; "
                "train with --motion control-points (or static)"
            )
        self.scene = scene
        self.rig = cast(Rig, scene.motion)
        with torch.no_grad():
            trajectories = self.rig.trajectories(sample_times(self.rig.moves))
            self.binding = self.rig.binding(scene.gaussians)
        self.graph = build_graph(trajectories, shared=self._shared())
        if not self.rig.moves:
            self.binding = _across_no_gap(self.graph, *self.binding)
        self.solver = ArapSolver(self.graph)
        self.player = Player(self.graph, self.solver, self.motion_at)
        unit_of = scene.normalisation
        self.units = np.asarray(unit_of.centre, np.float64), float(unit_of.scale)
        self._motions: OrderedDict[Any, MotionPose] = OrderedDict()
        self._bases: OrderedDict[Any, NodePose] = OrderedDict()
        self._bent: OrderedDict[Any, NodePose | None] = OrderedDict()
        self._live: _Live | None = None

    def _shared(self) -> np.ndarray:
        """[N, 2] the two nearest control points of every opaque Gaussian."""
        opaque = (self.scene.gaussians.opacities() > OPAQUE).cpu().numpy()
        return self.binding[0][:, :2].cpu().numpy()[opaque if opaque.any() else slice(None)]

    def to_world(self, points: np.ndarray) -> np.ndarray:
        centre, scale = self.units
        return points / scale + centre

    def motion_at(self, time: float) -> MotionPose:
        """The unedited control points."""
        return _remember(self._motions, time, lambda: motion_pose(self.rig, time))

    def base_at(self, edit: Edit, time: float) -> NodePose:
        """Control points with holds and exaggeration, before any handle."""
        key = time, edit.holds, edit.exaggerate
        return _remember(self._bases, key, lambda: self.player.play(time, edit.holds, edit.exaggerate))

    def targets(self, edit: Edit, at: float | None) -> dict[str, Target]:
        """Every handle's target: its keyframes' at a moment of the film, else where it is now."""
        led = targets_at(edit.keyframes, at) if at is not None else {}
        return {handle.name: led.get(handle.name, edit.targets.get(handle.name, STAY)) for handle in edit.handles}

    def bend(self, edit: Edit, time: float, at: float | None = None, *, frame: float = ONE_FRAME) -> NodePose | None:
        """The edited control points at a scene time, from nothing but the arguments.

        Args:
            at: moment of the film in seconds, for keyframes. None: the handles' present targets.
            frame: how far from its time an edit of one frame shows.

        Returns:
            None where the edit changes nothing: then the scene's own bits hold.
        """
        targets = self.targets(edit, at)
        said = tuple((name, target.translation, target.rotation) for name, target in targets.items())
        key = time, edit.handles, edit.pins, edit.holds, edit.exaggerate, said, frame

        def solve() -> NodePose | None:
            problem = self._problem(edit, time, targets, frame)
            if problem is None:
                return self._unbent(edit, time)
            rest = problem.base.positions
            sweeps = [goal.sweep(rest) for goal in problem.goals]
            steps = max(count_steps(turned, moved, self.graph.edge_length) for turned, moved in sweeps)
            path = lambda share: anchors_at(problem.goals, problem.pins, rest, share)  # noqa: E731
            return self._finish(problem, self.solver.solve(rest, path, steps))

        return _remember(self._bent, key, solve)

    def bend_live(self, edit: Edit, time: float, *, frame: float = ONE_FRAME) -> NodePose | None:
        """As ``bend`` with the present targets, quickly: from the last live solution. While a handle is dragged."""
        targets = self.targets(edit, None)
        problem = self._problem(edit, time, targets, frame)
        if problem is None:
            self._live = None
            return self._unbent(edit, time)
        key = time, edit.handles, edit.pins, edit.holds, edit.exaggerate, frame
        rest = problem.base.positions
        if self._live is None or self._live.key != key:
            self._live = _Live(key, {name: STAY for name in targets}, Shape.at_rest(rest))
        before, shape = self._live.targets, self._live.shape
        steps = self._distance(before, targets)
        taken = min(steps, LIVE_STEPS)
        for step in range(1, taken + 1):
            between = targets if step == steps else _between(before, targets, step / steps)
            goals = self._problem(edit, time, between, frame)
            anchors = anchors_at(goals.goals if goals else problem.goals, problem.pins, rest, 1.0)
            iterations = LIVE_ITERATIONS if step == steps else STEP_ITERATIONS // 2
            shape = self.solver.relax(rest, anchors, shape, iterations)
        reached = targets if taken == steps else _between(before, targets, taken / steps)
        self._live = _Live(key, reached, shape)
        return self._finish(problem, shape)

    def settled(self, edit: Edit) -> bool:
        """Whether the last live solution has caught up with the handles."""
        return self._live is None or self._live.targets == self.targets(edit, None)

    def gaussians(self, time: float, bent: NodePose | None) -> Gaussians:
        """Activated Gaussians, world units; ``bent`` as ``bend`` gives it."""
        if bent is None:
            return self.scene.gaussians_at(time)
        posed = self._posed(time, bent)
        undo = self.scene.normalisation
        return Gaussians(
            undo.undo(posed.means), posed.quats, undo.undo_scale(posed.scales), posed.opacities,
            posed.sh_dc.detach(), posed.sh_rest.detach(),
        )  # fmt: skip

    def normalised(self, time: float, bent: NodePose | None) -> Gaussians:
        """As ``gaussians``, in the normalised scene, for rendering."""
        if bent is None:
            with torch.no_grad():
                return self.scene.motion.gaussians_at(self.scene.gaussians, time)
        return self._posed(time, bent)

    def _posed(self, time: float, bent: NodePose) -> Gaussians:
        masked = bool(self.scene.config.motion.mask) and self.rig.moves
        return pose_gaussians(self.rig, self.scene.gaussians, self.motion_at(time), bent, self.binding, masked)

    def _unbent(self, edit: Edit, time: float) -> NodePose | None:
        base = self.base_at(edit, time)
        motion = self.motion_at(time).positions
        return None if np.array_equal(base.positions, motion) and not base.turns[:, 1:].any() else base

    def _problem(self, edit: Edit, time: float, targets: Mapping[str, Target], frame: float) -> _Problem | None:
        """Handles as goals at this time; None if none of them moves. Handles without strength now, and pieces of the
        graph in which nothing is moved, are left out: they stay to the bit."""
        base = self.base_at(edit, time)
        goals = []
        for handle in edit.handles:
            share = handle.strength(time, frame)
            if share == 0.0:
                continue
            then = base if handle.time == time else self.base_at(edit, handle.time)
            arguments = self.graph, then.positions, base.positions, self.units
            goals.append(carried_goal(handle, targets[handle.name], share, *arguments))
        component = self.graph.component
        moved = [component[goal.nodes] for goal in goals if not goal.is_identity]
        if not moved:
            return None
        alive = np.isin(component, np.concatenate(moved))
        used = [goal for goal in goals if alive[goal.nodes].any()]
        pins = np.array(edit.pins, np.int64)
        stay = np.isin(component, np.concatenate([component[goal.nodes] for goal in goals]))
        stay[pins] = True
        return _Problem(base, used, pins[alive[pins]], stay)

    def _finish(self, problem: _Problem, shape: Shape) -> NodePose:
        """Stray control points follow theirs."""
        base = problem.base
        turns = from_matrix(shape.rotations)
        positions, turns = self.graph.follow(base.positions, shape.positions, turns, problem.stay)
        return dataclasses.replace(base.then(positions, turns), base=base)

    def _distance(self, before: Mapping[str, Target], after: Mapping[str, Target]) -> int:
        """Sub-steps from one set of targets to another."""
        most = 1
        for name, target in after.items():
            old = before.get(name, STAY)
            cosine = min(abs(float(np.dot(old.rotation, target.rotation))), 1.0)
            shift = np.linalg.norm(np.subtract(target.translation, old.translation)) * self.units[1]
            most = max(most, count_steps(2.0 * float(np.arccos(cosine)), float(shift), self.graph.edge_length))
        return most


def _across_no_gap(
    graph: ControlGraph, indices: torch.Tensor, weights: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """A static scene's binding, without control points that are not tied to a Gaussian's nearest one."""
    nodes = indices.long().cpu().numpy()
    tied = (
        np.asarray(graph.matrix[nodes[:, :1].repeat(nodes.shape[1], 1).ravel(), nodes.ravel()]).reshape(nodes.shape) > 0
    )
    tied[:, 0] = True
    kept = weights * torch.from_numpy(tied).to(weights.device)
    total = kept.sum(dim=1, keepdim=True)
    nearest = torch.zeros_like(kept)
    nearest[:, 0] = 1.0
    return indices, torch.where(total > 1e-6, kept / total.clamp_min(1e-6), nearest)


def _between(before: Mapping[str, Target], after: Mapping[str, Target], share: float) -> dict[str, Target]:
    found = {}
    for name, target in after.items():
        old = before.get(name, STAY)
        shift = np.array(old.translation) + share * np.subtract(target.translation, old.translation)
        turn = unit(slerp(np.array(old.rotation), np.array(target.rotation), share))
        found[name] = Target.of(shift.tolist(), turn.tolist())
    return found


def _remember(cache: OrderedDict[Any, Value], key: Any, make: Callable[[], Value]) -> Value:
    """The value under ``key``, made if it is new; the oldest ones are forgotten."""
    if key in cache:
        cache.move_to_end(key)
        return cache[key]
    value = cache[key] = make()
    while len(cache) > CACHED:
        cache.popitem(last=False)
    return value
