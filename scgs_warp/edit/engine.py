"""The engine applies an edit to control points at any time, and to the Gaussians that follow them.

For the same edit and time, results are bit-identical in whatever order they are requested. Live results are the
exception: each is computed from the previous one.
"""

from __future__ import annotations

import copy
import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import torch

from ..errors import UserError
from ..motion.static import Static
from ..ops.shapes import shown
from ..scene.from_gaussians import with_control_points
from ..scene.scene import Scene
from ..types import Gaussians
from .document import Edit
from .graph import ControlGraph, build_graph, sample_times
from .handles import ONE_FRAME, STAY, Goal, Target, anchors_at, carried_goal
from .keyframes import targets_at
from .part_pose import PartMove, PartPoser
from .part_skin import PartSkin, part_skin
from .player import Player
from .pose import MotionPose, NodePose, Rig, edited_gaussians, motion_pose
from .rotations import from_matrix, slerp, unit
from .skeleton import Skeleton
from .solver import STEP_ITERATIONS, ArapSolver, Shape, count_steps

CACHED_INSTANTS = 64
"""Largest number of entries in each cache of control points."""
LIVE_STEPS = 4
"""Largest number of sub-steps in one drag update; a longer drag catches up during the next updates."""
LIVE_ITERATIONS = 8
CACHED_POSERS = 4
FREE_AROUND_HANDLES = 3
"""Number of rings around a handle of control points within which posed parts are free to follow it."""
MIN_OPACITY = 0.1
"""Opacity below which a Gaussian does not connect control points."""

Value = TypeVar("Value")


class _Problem(NamedTuple):
    """Input of the solver at one instant."""

    base: NodePose
    goals: list[Goal]
    pins: np.ndarray
    stay: np.ndarray
    """[M] bool: strays that do not follow their leader, because they are pinned or a handle acts on their component."""
    graph: ControlGraph
    solver: ArapSolver
    skin: PartSkin | None


class _Live(NamedTuple):
    """State of the latest live solution."""

    key: Any
    targets: dict[str, Target]
    shape: Shape


class Engine:
    """Engine that bends the control points of one scene.

    Attributes: ``scene`` (a static one is given control points), ``rig``, ``binding``, ``graph``, ``units`` (centre and
    scale of the normalised scene).

    Raises:
        UserError: the motion model has no control points.
    """

    def __init__(self, scene: Scene) -> None:
        if not hasattr(scene, "motion"):
            raise UserError(f"scene is {shown(scene)}; give a scgs_warp.Scene, such as Scene.load returns")
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
        self._posers: OrderedDict[Any, PartPoser] = OrderedDict()
        self._skins: OrderedDict[Any, PartSkin] = OrderedDict()
        self._live: _Live | None = None
        self._under: tuple[float, NodePose, Gaussians] | None = None
        """Gaussians under an edit's holds and exaggeration alone, which stay while parts are dragged."""

    @property
    def masked(self) -> bool:
        """Whether Gaussians take part in the motion by a learnt share; handles move all of them whole."""
        return bool(self.scene.config.motion.mask) and self.rig.moves

    def drawn_with(self, scene: Scene) -> Engine:
        """Return an engine that bends as this one and poses the Gaussians of another scene, whose places, neighbours
        and motion are those of this one's. The two share caches."""
        other = copy.copy(self)
        other.scene, other._under = scene, None
        return other

    def _shared(self) -> np.ndarray:
        """Return the two nearest control points of every opaque Gaussian, [N, 2]."""
        opaque = (self.scene.gaussians.opacities() > MIN_OPACITY).cpu().numpy()
        return self.binding[0][:, :2].cpu().numpy()[opaque if opaque.any() else slice(None)]

    def to_world(self, points: np.ndarray) -> np.ndarray:
        centre, scale = self.units
        return points / scale + centre

    def motion_at(self, time: float) -> MotionPose:
        """Return the unedited control points."""
        return _remember(self._motions, time, lambda: motion_pose(self.rig, time))

    def base_at(self, edit: Edit, time: float) -> NodePose:
        """Return the control points with the edit's holds and exaggeration applied, but no handles."""
        key = time, edit.holds, edit.exaggerate
        return _remember(self._bases, key, lambda: self.player.play(time, edit.holds, edit.exaggerate))

    def targets(self, edit: Edit, at: float | None) -> dict[str, Target]:
        """Return every handle's target: from its keyframes at a moment of the film, otherwise its present one."""
        led = targets_at(edit.keyframes, at) if at is not None else {}
        return {handle.name: led.get(handle.name, edit.targets.get(handle.name, STAY)) for handle in edit.handles}

    def bend(self, edit: Edit, time: float, at: float | None = None, *, frame: float = ONE_FRAME) -> NodePose | None:
        """Return the edited control points at a scene time. The result depends on the arguments alone.

        Args:
            at: moment of the film in seconds, for keyframes. None: the handles' present targets.
            frame: largest distance from a handle's time, in scene time, at which a one-frame edit still shows.

        Returns:
            The pose, or None where the edit changes nothing, so that results are bit-identical to the unedited scene's.
        """
        targets = self.targets(edit, at)
        said = tuple((name, target.translation, target.rotation) for name, target in targets.items())
        turned = tuple(edit.turned(handle.name) for handle in edit.handles)
        key = time, edit.handles, edit.pins, edit.holds, edit.exaggerate, said, turned, frame, edit.skeleton, edit.skin

        def solve() -> NodePose | None:
            problem = self._problem(edit, time, targets, frame)
            if problem is None:
                return self._unbent(edit, time)
            rest = problem.base.positions
            sweeps = [goal.sweep() for goal in problem.goals]
            steps = max(count_steps(turned, moved, self.graph.edge_length) for turned, moved in sweeps)
            path = lambda share: anchors_at(problem.goals, problem.pins, rest, share)  # noqa: E731
            return self._finish(problem, problem.solver.solve(rest, path, steps))

        return _remember(self._bent, key, solve)

    def bend_live(self, edit: Edit, time: float, *, frame: float = ONE_FRAME) -> NodePose | None:
        """Return the edited control points for the present targets, starting from the previous live solution, which is
        fast enough for drags."""
        targets = self.targets(edit, None)
        problem = self._problem(edit, time, targets, frame)
        if problem is None:
            self._live = None
            return self._unbent(edit, time)
        turned = tuple(edit.turned(handle.name) for handle in edit.handles)
        posed = problem.solver is not self.solver  # a shape on one graph is no start on another
        key = time, edit.handles, edit.pins, edit.holds, edit.exaggerate, turned, frame, edit.skeleton, posed
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
            shape = problem.solver.relax(rest, anchors, shape, problem.solver.pace * iterations)
        reached = targets if taken == steps else _between(before, targets, taken / steps)
        self._live = _Live(key, reached, shape)
        return self._finish(problem, shape)

    def settled(self, edit: Edit) -> bool:
        """Return whether the latest live solution has caught up with the handles."""
        return self._live is None or self._live.targets == self.targets(edit, None)

    def gaussians(self, time: float, bent: NodePose | None) -> Gaussians:
        """Return activated Gaussians, world units, for the result of ``bend``; sharp ones are approximated
        (``Gaussians.plain``)."""
        if bent is None:
            return self.scene.gaussians_at(time)
        posed = self._posed(time, bent)
        undo = self.scene.normalisation
        return Gaussians(
            undo.undo(posed.means), posed.quats, undo.undo_scale(posed.scales), posed.opacities,
            posed.sh_dc.detach(), posed.sh_rest.detach(), posed.sharpness,
        ).plain()  # fmt: skip

    def normalised(self, time: float, bent: NodePose | None) -> Gaussians:
        """Return activated Gaussians in normalised units, for rendering."""
        if bent is None:
            with torch.no_grad():
                return self.scene.motion.gaussians_at(self.scene.gaussians, time)
        return self._posed(time, bent)

    def _posed(self, time: float, bent: NodePose) -> Gaussians:
        masked = self.masked
        model = self.rig, self.scene.gaussians, self.motion_at(time)
        if bent.base is None or bent.skin is None:
            self._under = None
            return edited_gaussians(*model, bent, self.binding, masked)
        if self._under is None or self._under[0] != time or self._under[1] is not bent.base:
            self._under = time, bent.base, edited_gaussians(*model, bent.base, self.binding, masked)
        return edited_gaussians(*model, bent, self.binding, masked, self._under[2])

    def _unbent(self, edit: Edit, time: float) -> NodePose | None:
        base = self.base_at(edit, time)
        motion = self.motion_at(time).positions
        return None if np.array_equal(base.positions, motion) and not base.turns[:, 1:].any() else base

    def _problem(self, edit: Edit, time: float, targets: Mapping[str, Target], frame: float) -> _Problem | None:
        """Turn handles into goals at this time; return None if nothing moves. Handles whose strength is 0 at this time,
        and components of the graph in which nothing moves, are left out, so that their control points stay
        bit-identical."""
        base = self.base_at(edit, time)
        goals, moves = [], []
        for handle in edit.handles:
            share = handle.strength(time, frame)
            if share == 0.0:
                continue
            then = base if handle.time == time else self.base_at(edit, handle.time)
            target = targets[handle.name]
            if handle.part is not None:
                moves.append(PartMove(handle, target, share, then.positions))
                continue
            arguments = self.graph, then.positions, base.positions, self.units, edit.turned(handle.name)
            goals.append(carried_goal(handle, target, share, *arguments))
        graph, solver, skin = self.graph, self.solver, None
        posed = self._part_goals(edit, moves, goals, base.positions)
        if posed:
            assert edit.skeleton is not None
            poser, skin = self.poser(edit.skeleton), self._skin(edit)
            graph, solver, goals = poser.graph, poser.solver, [*posed, *goals]
        component = graph.component
        moved = [component[goal.nodes] for goal in goals if not goal.is_identity]
        if not moved:
            return None
        alive = np.isin(component, np.concatenate(moved))
        used = [goal for goal in goals if alive[goal.nodes].any()]
        pins = np.array(edit.pins, np.int64)
        stay = np.isin(component, np.concatenate([component[goal.nodes] for goal in goals]))
        stay[pins] = True
        return _Problem(base, used, pins[alive[pins]], stay, graph, solver, skin)

    def poser(self, skeleton: Skeleton) -> PartPoser:
        """Return the poser of a skeleton's parts."""

        def make() -> PartPoser:
            return PartPoser(skeleton, self.graph, self.motion_at(0.0).positions, self.units)

        return _remember(self._posers, skeleton, make, CACHED_POSERS)

    def _skin(self, edit: Edit) -> PartSkin | None:
        """Return the skin of the edit's parts; None: Gaussians follow by their own binding."""
        if edit.skeleton is None or edit.skin == "nodes":
            return None
        poser, dual = self.poser(edit.skeleton), edit.skin == "dual"
        make = lambda: part_skin(self.binding, poser.owner, poser.graph, dual)  # noqa: E731
        return _remember(self._skins, (edit.skeleton, dual), make, CACHED_POSERS)

    def _part_goals(self, edit: Edit, moves: list[PartMove], others: list[Goal], now: np.ndarray) -> list[Goal]:
        """Return the goals of posed parts, none if no target moves a part. Control points near other handles are left
        free."""
        if edit.skeleton is None or not any(not move.target.is_identity for move in moves):
            return []
        released = np.zeros(len(self.graph), bool)
        near = {node for goal in others if not goal.is_identity for node in goal.nodes.tolist()}
        if near:
            released[list(self.graph.ring(near, FREE_AROUND_HANDLES))] = True
        return self.poser(edit.skeleton).goals(moves, now, released)

    def _finish(self, problem: _Problem, shape: Shape) -> NodePose:
        """Move strays (see ``graph.ControlGraph``) with their leaders, and compose the result with the base pose."""
        base = problem.base
        turns = from_matrix(shape.rotations)
        positions, turns = problem.graph.follow(base.positions, shape.positions, turns, problem.stay)
        return dataclasses.replace(base.then(positions, turns), base=base, skin=problem.skin)

    def _distance(self, before: Mapping[str, Target], after: Mapping[str, Target]) -> int:
        """Return the number of sub-steps from one set of targets to another."""
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
    """Restrict a static scene's binding to control points that share an edge with the Gaussian's nearest one."""
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
    between = {}
    for name, target in after.items():
        old = before.get(name, STAY)
        shift = np.array(old.translation) + share * np.subtract(target.translation, old.translation)
        turn = unit(slerp(np.array(old.rotation), np.array(target.rotation), share))
        between[name] = Target.of(shift.tolist(), turn.tolist())
    return between


def _remember(
    cache: OrderedDict[Any, Value], key: Any, make: Callable[[], Value], most: int = CACHED_INSTANTS
) -> Value:
    """Return the cached value of ``key``; compute it if it is missing, and evict the least recently used values."""
    if key in cache:
        cache.move_to_end(key)
        return cache[key]
    value = cache[key] = make()
    while len(cache) > most:
        cache.popitem(last=False)
    return value
