"""Benchmarks of the editor: from a drag of a handle to what its pages get."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from ..edit import EditSession, Target, engine
from ..edit.handles import STAY
from ..editor import pictures, poses
from ..editor.model import EditorModel
from ..export import page_edit
from ..ops.sampling import farthest_points
from ..rendering import render
from .plan import BenchCase
from .scenes import scene_camera
from .workloads import draw_stages

HANDLES = 3
STEP = 0.25
"""Motion of a handle from one drag to the next, in edge lengths of the graph."""


def edit_rows(case: BenchCase) -> list[dict[str, Any]]:
    """Measure drags of one of three handles at the scene's far ends, with nothing pinned, so that every control point
    and every Gaussian moves: up to the pose that pages draw, and up to the picture for pages without WebGL 2."""
    session = EditSession(case.scene)
    model = EditorModel(session)
    model.pin_rings = None
    hold(model)
    camera = scene_camera(case.scene, case.plan.size)
    reach = STEP * session.graph.edge_length / session.engine.units[1]

    def drag(index: int) -> None:
        along = reach * index
        model.drag(Target((0.0, 4 * reach * math.sin(along / (4 * reach)), 0.0)))

    def pose(index: int) -> None:
        drag(index)
        poses.pose_message(poses.pose_table(session, model.moment()), 1, -1)

    def picture(index: int) -> None:
        drag(index)
        poses.picture_message(pictures.scene_jpeg(session, model.moment(), camera), 1)

    solve = {"solve": [(session.engine, "bend_live")]}
    pose_stages = {
        **solve,
        "compose": [(page_edit, "compose"), (page_edit, "own_pose")],
        "pack": [(poses, "_table"), (poses, "pose_message")],
    }
    picture_stages = {
        **solve,
        "skin": [(engine, "pose_gaussians")],
        **draw_stages(render),
        "bytes": [(pictures, "to_bytes")],
        "encode": [(pictures, "_jpeg"), (poses, "picture_message")],
    }
    return case.rows("edit/drag", pose, pose_stages) + case.rows("edit/picture", picture, picture_stages)


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
