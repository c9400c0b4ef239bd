"""Benchmarks of the editor: from a drag of a handle or of a part to what its pages get."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from ..edit import EditSession, Target, engine
from ..edit.handles import STAY
from ..editor import pictures, poses
from ..editor.model import EditorModel
from ..editor.parts_tool import PartsTool
from ..export import page_edit
from ..ops.sampling import farthest_points
from ..rendering import render
from .plan import BenchCase
from .scenes import scene_camera
from .workloads import draw_stages

Targets = dict[str, list[tuple[Any, str]]]
"""Functions of each stage, as objects and names of their attributes."""
HANDLES = 3
STEP = 0.25
"""Motion of a handle or of a part from one drag to the next, in edge lengths of the graph."""
SWING = 4
"""Largest distance of a handle or of a part from where it was grabbed, in steps."""
PARTS = 12
"""Number of parts of a synthetic scene, whose own motion bends no joint: those of a figure with elbows and knees."""
LEAST_NODES = 4
"""Mean number of control points of a part in a scene that is too small for ``PARTS``."""


def edit_rows(case: BenchCase) -> list[dict[str, Any]]:
    """Measure drags of one of three handles at the scene's far ends, with nothing pinned, so that every control point
    and every Gaussian moves: up to the pose that pages draw, and up to the picture for pages without WebGL 2."""
    session = EditSession(case.scene)
    model = EditorModel(session)
    model.pin_rings = None
    hold(model)
    reach = _reach(session)

    def drag(index: int) -> None:
        model.drag(Target((0.0, SWING * reach * math.sin(index / SWING), 0.0)))

    return _rows(case, model, drag, "edit", {})


def pull_rows(case: BenchCase) -> list[dict[str, Any]]:
    """Measure pulls of the part with the longest chain of joints, likewise."""
    session = EditSession(case.scene)
    if case.plan.run is None:
        session.use_parts(min(PARTS, len(session.node_positions(0.0)) // LEAST_NODES))
    tool = PartsTool(EditorModel(session))
    ends = [part for part in session.parts() if part.parent is not None] or session.parts()
    part = max(ends, key=lambda part: len(session.skeleton.chain(part.name)))
    tool.choose(part.name)
    tool.grab()
    grip = session.node_positions(0.0)[list(part.nodes)].mean(axis=0)
    up = np.array([0.0, SWING * _reach(session), 0.0])

    def pull(index: int) -> None:
        tool.pull(grip + up * math.sin(index / SWING), grip)

    kinematics = {"kinematics": [(session, "_reached")]}
    return _rows(case, tool.model, pull, "pull", kinematics)


def _reach(session: EditSession) -> float:
    """Return the distance from one drag to the next, world units."""
    return STEP * session.graph.edge_length / session.engine.units[1]


def _rows(
    case: BenchCase, model: EditorModel, drag: Callable[[int], None], name: str, stages: Targets
) -> list[dict[str, Any]]:
    """Measure ``drag`` up to a page's pose and up to a picture; ``stages`` are those of the drag."""
    session = model.session
    camera = scene_camera(case.scene, case.plan.size)

    def pose(index: int) -> None:
        drag(index)
        poses.pose_message(poses.pose_table(session, model.moment()), 1, -1)

    def picture(index: int) -> None:
        drag(index)
        poses.picture_message(pictures.scene_jpeg(session, model.moment(), camera), 1)

    solve = {**stages, "solve": [(session.engine, "bend_live")]}
    pose_stages = {
        **solve,
        "compose": [(page_edit, "compose"), (page_edit, "own_pose")],
        "pack": [(poses, "_table"), (poses, "pose_message")],
    }
    picture_stages = {
        **solve,
        "skin": [(engine, "edited_gaussians")],
        **draw_stages(render),
        "bytes": [(pictures, "to_bytes")],
        "encode": [(pictures, "_jpeg"), (poses, "picture_message")],
    }
    return case.rows(f"{name}/drag", pose, pose_stages) + case.rows(f"{name}/picture", picture, picture_stages)


def hold(model: EditorModel) -> None:
    """Set three handles far from each other, and grab the first one. They lie on the largest connected piece of the
    graph: a handle on a piece of its own would move nothing else."""
    session = model.session
    pieces = connected_components(session.graph.matrix, directed=False)[1]
    largest = np.flatnonzero(pieces == np.bincount(pieces).argmax())
    points = session.scene.gaussians.means.new_tensor(session.node_positions(0.0)[largest])
    ends = largest[farthest_points(points, min(HANDLES, len(points))).cpu().numpy()].tolist()
    for end in reversed(ends):
        model.select(session.ring([end], 1))
        model.grab(STAY)
        model.drag(STAY)  # A handle that never moved would be dropped.
        model.release()
    model.grab(STAY)
