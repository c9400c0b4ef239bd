"""Small scenes to edit, made on the spot: a bar of Gaussians that bends in time, and the built-in figure's surface."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from scipy.sparse.csgraph import shortest_path

from scgs_warp.config.presets import from_dict
from scgs_warp.data.synthetic.builtin import sample_surface
from scgs_warp.data.synthetic.figure import PARTS, build_figure
from scgs_warp.data.synthetic.figure_motion import BONES, bone_transforms
from scgs_warp.edit import EditSession
from scgs_warp.edit.rotations import from_matrix
from scgs_warp.edit.skeleton import Part, Skeleton
from scgs_warp.gaussians import GaussianParameters, gaussians_from_points
from scgs_warp.geometry.cameras import Overview
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.motion import build_motion
from scgs_warp.motion.control_points import ControlPoints
from scgs_warp.motion.static_nodes import spacing
from scgs_warp.ops.sampling import farthest_points
from scgs_warp.scene.scene import Scene
from scgs_warp.types import Pose

OVERVIEW = Overview((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 4.0, 40.0, 15.0)


class Puppet(ControlPoints):
    """Control points, each rigid on a bone of the built-in figure: its true motion."""

    bones: list[str]

    def poses(self, times: torch.Tensor) -> list[Pose]:
        found = []
        rest = self.positions.detach().double().numpy()
        start = bone_transforms(0.0)
        for time in times.tolist():
            now = bone_transforms(time)
            moves = {name: now[name] @ np.linalg.inv(start[name]) for name in now}
            matrices = np.stack([moves[bone] for bone in self.bones])
            shift = np.einsum("pij,pj->pi", matrices[:, :3, :3], rest) + matrices[:, :3, 3] - rest
            quats = from_matrix(matrices[:, :3, :3])
            found.append(Pose(torch.from_numpy(shift).float(), torch.from_numpy(quats).float()))
        return found


class Swing(ControlPoints):
    """Control points with a formula for a network: those at x > 0 swing about y by 60 degrees, once."""

    def poses(self, times: torch.Tensor) -> list[Pose]:
        found = []
        rest = self.positions.detach()
        for time in times.tolist():
            turn = math.radians(60.0) * time * (rest[:, 0].clamp(0.0, 0.5) / 0.5)
            c, s = turn.cos(), turn.sin()
            moved = torch.stack([c * rest[:, 0] + s * rest[:, 2], rest[:, 1], c * rest[:, 2] - s * rest[:, 0]], 1)
            zero = torch.zeros_like(turn)
            quats = torch.stack([(turn / 2).cos(), zero, (turn / 2).sin(), zero], 1)
            found.append(Pose(moved - rest, quats))
        return found


def bar_points(count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([2.4, 0.3, 0.3])


def dress(
    points: torch.Tensor,
    seed: int = 3,
    degree: int = 3,
    shaded: bool = False,
    hyper_columns: int = 0,
    corrected: bool = False,
) -> GaussianParameters:
    """Opaque Gaussians of random colours."""
    generator = torch.Generator().manual_seed(seed)
    colors = torch.rand(len(points), 3, generator=generator)
    fields = {"sh_degree": degree, "hyper_columns": hyper_columns, "shaded": shaded, "corrected": corrected}
    made = gaussians_from_points(points, colors, **fields)
    with torch.no_grad():
        made.opacity_logits.fill_(2.0)
        made.quats.copy_(torch.randn(len(points), 4, generator=generator))
        made.sh_rest.copy_(0.2 * torch.randn(made.sh_rest.shape, generator=generator))
        made.shading.copy_(0.2 * torch.randn(made.shading.shape, generator=generator))
        made.correctives.copy_(0.3 * torch.randn(made.correctives.shape, generator=generator))
    return made


def bar_scene(
    nodes: int = 60,
    gaussians: int = 400,
    seed: int = 0,
    shaded: bool = False,
    scale: float = 2.0,
    stray: tuple[float, float, float] | None = None,
    share: float | None = None,
    corrected: bool = False,
) -> Scene:
    """A bar along x, 2.4 / ``scale`` long in world units, one half of which swings.

    Args:
        stray: position of one more control point, the last, in normalised units.
        share: share of the motion in which Gaussians take part, by a mask; None: no mask.
    """
    fields = {"nodes": nodes, "layers": 1, "width": 8, "skip": 0, "mask": share is not None}
    config = from_dict({"motion": fields})
    template = build_motion("control-points", config)
    assert isinstance(template, ControlPoints)
    points = bar_points(gaussians, seed)
    places = points[farthest_points(points, nodes)]
    if stray is not None:
        places = torch.cat([places, torch.tensor([stray])])
    motion = Swing(places, torch.full((len(places),), 0.12), template.network, config.motion)
    unit = Normalisation(np.array([0.5, -1.0, 0.25]), scale)
    made = dress(points, shaded=shaded, hyper_columns=config.motion.hyper_columns, corrected=corrected)
    if share is not None:
        with torch.no_grad():
            made.hyper[:, -1] = torch.tensor(share).logit()
    scene = Scene(made, motion, unit, config, OVERVIEW)
    scene.motion.eval()
    scene.freeze_binding()
    return scene


def figure_surface(points: int = 6000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """The built-in figure at time 0: surface points [P, 3] and the bone of each [P]. Points inside another part, which
    no camera would have seen, are left out."""
    figure = build_figure()
    part, local = sample_surface(figure, points, np.random.default_rng(seed))
    transforms = bone_transforms(0.0)
    matrices = np.stack([transforms[p.bone] for p in PARTS])[part]
    world = np.einsum("pij,pj->pi", matrices[:, :3, :3], local) + matrices[:, :3, 3]
    hidden = np.zeros(len(world), bool)
    for index, other in enumerate(PARTS):
        if other.hole:
            continue
        inverse = np.linalg.inv(transforms[other.bone])
        inside = world @ inverse[:3, :3].T + inverse[:3, 3] - np.array(other.offset)
        core = np.maximum(np.array(other.half) - other.radius, 0.0)
        away = np.linalg.norm(inside - inside.clip(-core, core), axis=1)
        hidden |= (away < 0.95 * other.radius) & (part != index)
    return world[~hidden], np.array([PARTS[index].bone for index in part[~hidden]])


def figure_scene(nodes: int = 256, points: int = 12000) -> tuple[Scene, np.ndarray, np.ndarray]:
    """The built-in figure with its true motion: scene, its Gaussians at time 0 [P, 3], the bone of each [P]. Control
    points are chosen by trajectory and lie some way inside, as trained ones do."""
    world, bones = figure_surface(points)
    config = from_dict({"motion": {"nodes": nodes, "layers": 1, "width": 8, "skip": 0}})
    template = build_motion("control-points", config)
    assert isinstance(template, ControlPoints)
    surface = torch.from_numpy(world).float()
    chosen = farthest_points(surface, nodes)
    places = surface[chosen]
    motion = Puppet(places, spacing(places) * 0.5, template.network, config.motion)
    motion.bones = [str(bone) for bone in bones[chosen.numpy()]]
    made = dress(surface, degree=0, hyper_columns=config.motion.hyper_columns)
    scene = Scene(made, motion, Normalisation.identity(), config, OVERVIEW)
    scene.motion.eval()
    scene.freeze_binding()
    return scene, world, bones


def rich_scene() -> Scene:
    """Return a scene with every feature of a page: hyper-coordinates, a share of the motion, rotations of shapes,
    changing scales, six neighbours, antialiasing, sharp Gaussians."""
    scene = bar_scene(nodes=30, gaussians=300, shaded=True, share=0.8)
    motion = scene.motion
    motion.config = dataclasses.replace(motion.config, neighbors=6)
    swing = motion.poses

    def poses(times: torch.Tensor) -> list[Pose]:
        found = []
        for time, pose in zip(times.tolist(), swing(times)):
            half = 0.4 * time * torch.ones(len(pose.translations))
            shapes = torch.stack([half.cos(), half.sin(), 0 * half, 0 * half], 1)
            found.append(Pose(pose.translations, pose.rotations, -shapes, 0.5 * time * pose.translations))
        return found

    motion.poses = poses  # type: ignore[method-assign]
    scene.config = dataclasses.replace(scene.config, antialiased=True, sharpness=0.5)
    scene.gaussians.sharpness = 0.5
    scene.gaussians.log_scales.data += 0.4
    scene.freeze_binding()
    return scene


def tinted_scene(**options: Any) -> Scene:
    """Return a scene whose control points also change the colours: darker at the end, by position."""
    scene = bar_scene(**options)
    plain = scene.motion.poses

    def poses(times: torch.Tensor) -> list[Pose]:
        found = zip(times.tolist(), plain(times), strict=True)
        slope = torch.tensor([[1.0, -0.5, 0.2]]) * scene.motion.positions.detach()[:, :1]
        return [Pose(pose.translations, pose.rotations, tints=time * slope) for time, pose in found]

    scene.motion.poses = poses  # type: ignore[method-assign]
    scene.freeze_binding()
    return scene


def bone_skeleton(bones: list[str]) -> Skeleton:
    """The figure's true bones as parts, of those that hold control points."""
    there, joints = set(bones), bone_transforms(0.0)
    parts = []
    for name, bone in BONES.items():
        if name in there:
            parent = bone.parent
            while parent is not None and parent not in there:
                parent = BONES[parent].parent
            nodes = tuple(np.flatnonzero(np.array(bones) == name).tolist())
            parts.append(Part(name, nodes, parent, tuple(joints[name][:3, 3].tolist())))
    return Skeleton(tuple(parts))


def furthest(session: EditSession, part: str) -> list[int]:
    """Return the part's control points with the most edges to every other part, which are held in any case."""
    inside = session.skeleton.owners() == session.skeleton.names.index(part)
    away = shortest_path(session.engine.poser(session.skeleton).graph.matrix, unweighted=True)[:, ~inside].min(1)
    return np.flatnonzero(inside & (away == away[inside].max())).tolist()
